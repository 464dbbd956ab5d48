#pragma once

constexpr int ADAM_ROWS = 48;         // parameters of a launch
constexpr int ADAM_THREADS = 256;     // of a block, each for four numbers of a parameter
constexpr int JUDGED_METRICS = 32;    // of a gradient step
constexpr int CHECKED_TENSORS = 16;   // of a rollout
constexpr int CHECKED_THREADS = 256;  // of a block
constexpr int CHECKED_WORDS = 4;      // of 16 bytes, that a thread reads
constexpr int RECORD_THREADS = 1024;
constexpr int N_SUMS = 7;        // of PPO's loss: see PpoLossParams
constexpr int TD_THREADS = 256;  // of a block
constexpr int TD_SEQUENCES = 8;  // of a block, whose numbers fill a sector of 32 bytes
constexpr int N_TD_SUMS = 7;
constexpr int N_TD_METRICS = 7;
