#pragma once

constexpr int MAX_LEAVES = 8;          // of an observation, that a launch handles
constexpr int NORMALISED_ROWS = 4;     // rows that a thread normalises
constexpr int STRIP = 128;             // rows that a block adds up
constexpr int STRIP_THREADS = 256;     // of such a block
constexpr int ACT_THREADS = 8;         // that choose one lane's actions, one per choice
constexpr int MOMENTS_LANES = 1024;    // of a block, for one statistic
constexpr int MOMENTS_THREADS = 1024;  // of a block that adds moments
constexpr int MASKED_ARRAYS = 4;       // whose moments a launch computes
constexpr int MASKED_THREADS = 256;    // of a block
constexpr int MASKED_NUMBERS = 8;      // of an array, that a thread reads
constexpr int CAST_ROWS = 48;          // weights of a launch
constexpr int CAST_THREADS = 256;      // of a block
constexpr int DUELLING_OUTPUTS = 8;    // action values of a lane, at most
constexpr int DUELLING_STRIP = 128;    // rows that a block of their gradients adds up
constexpr int DUELLING_THREADS = 256;  // of such a block, two columns each

constexpr float UNKNOWN_SCALE = 1e30f;  // divides a number that has not varied yet
constexpr float RESOLUTION = 1e-5f;     // of a mean, which rounding errors stay below
