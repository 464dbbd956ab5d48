#pragma once

constexpr int SEQUENCE_THREADS = 256;  // threads of a block
constexpr int SEQUENCE_LANES = 32;     // lanes of a cluster
constexpr int BLOCK_UNITS = 64;        // units of a block
constexpr int MAX_STEPS = 512;
constexpr int FORWARD_MEMORY = 108064;  // bytes of shared memory of a block, for 256 units
constexpr int BACKWARD_MEMORY = 126496;
