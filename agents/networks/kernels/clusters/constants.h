#pragma once

constexpr int SEQUENCE_THREADS = 256;  // threads of a block
constexpr int BLOCK_UNITS = 64;        // units of a block
// Lanes of a cluster. An H200 runs 30 clusters of four blocks at once: with 40 lanes they hold the
// 1,024 lanes of the default minibatch.
constexpr int SEQUENCE_LANES = 40;
constexpr int MAX_STEPS = 512;  // of a sequence
// Bytes of shared memory of a block, for 128 and for 256 units
constexpr int FORWARD_MEMORY_128 = 136608;
constexpr int BACKWARD_MEMORY_128 = 85920;
constexpr int FORWARD_MEMORY_256 = 159648;
constexpr int BACKWARD_MEMORY_256 = 135072;
