#pragma once

constexpr int ADAM_ROWS = 48;      // parameters of a launch
constexpr int ADAM_NUMBERS = 16;   // of a parameter, that a thread handles
constexpr int SIZES_TENSORS = 16;  // of a rollout that is checked
constexpr int SIZES_THREADS = 8;   // that read one row of a tensor
constexpr int RECORD_THREADS = 1024;
constexpr int EPISODE_METRICS = 8;  // of a world
constexpr int TD_THREADS = 256;     // of a block
constexpr int TD_SEQUENCES = 8;     // of a block, whose numbers fill a sector of 32 bytes
constexpr int N_TD_SUMS = 7;
constexpr int N_TD_METRICS = 7;
