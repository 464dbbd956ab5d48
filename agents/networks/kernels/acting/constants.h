#pragma once

constexpr int STEP_LANES = 128;    // of a block
constexpr int STEP_ROWS = 128;     // of the weights, of a block
constexpr int STEP_INNER = 64;     // numbers of the product's inner axis at once, a part
constexpr int STEP_STAGES = 3;     // parts in shared memory
constexpr int STEP_THREADS = 256;  // of a block
