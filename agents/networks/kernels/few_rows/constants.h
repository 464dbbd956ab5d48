#pragma once

constexpr int MAX_ROWS = 2048;     // of a product; of more, larger blocks are faster
constexpr int TILE = 64;           // rows and columns of a block's results
constexpr int TILE_THREADS = 128;  // of a block
constexpr int TILE_BYTES = 36864;  // of a block's shared memory
