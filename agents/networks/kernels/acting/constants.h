#pragma once

constexpr int STEP_LANES = 128;    // of a block
constexpr int STEP_UNITS = 64;     // of a block, and of a part of the product's inner axis
constexpr int STEP_PARTS = 4;      // such parts, at most
constexpr int STEP_THREADS = 256;  // of a block
// Bytes of shared memory:
constexpr int PART_BYTES = 32768;  // for a part of a block's lanes and weights
constexpr int STATE_BYTES = 288;   // for a lane's states
constexpr int BIAS_BYTES = 256;    // for a block's biases
