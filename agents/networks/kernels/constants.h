#pragma once

constexpr int MAX_LEAVES = 4;       // of an observation that is normalised at once
constexpr int NORMALISED_ROWS = 4;  // rows that a thread normalises
constexpr int STRIP = 128;          // rows that a block adds up
constexpr int STRIP_THREADS = 256;  // of such a block
constexpr int ACT_THREADS = 8;      // that choose one lane's actions, one per choice
