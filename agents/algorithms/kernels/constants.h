#pragma once

constexpr int ADAM_ROWS = 48;      // parameters of a launch
constexpr int ADAM_NUMBERS = 16;   // of a parameter, that a thread handles
constexpr int SIZES_TENSORS = 16;  // of a rollout that is checked
constexpr int SIZES_THREADS = 8;   // that read one row of a tensor
constexpr int RECORD_THREADS = 1024;
constexpr int EPISODE_METRICS = 8;     // of a world
constexpr int MOMENTS_QUANTITIES = 4;  // of one mask
constexpr int MOMENTS_THREADS = 256;   // of a block
constexpr int MOMENTS_NUMBERS = 8;     // that a thread handles
