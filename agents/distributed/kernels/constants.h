#pragma once

constexpr int PACK_ROWS = 96;      // of a launch
constexpr int PACK_THREADS = 256;  // of a block, each for four numbers
