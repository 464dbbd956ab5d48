// How both kernels of the encoder `Conv` are divided among threads: a block handles tiles of rows.
#pragma once
#include "common/dependent_launch.h"
#include "common/tensor_cores.h"
#include "constants.h"
#include "params.h"

// Blocks of a multiprocessor: two leave a thread 255 registers.
#define BOUNDS(n_blocks) __launch_bounds__(THREADS, n_blocks)

constexpr int THREADS = CONV_THREADS, WARPS = THREADS / 32, ROWS = CONV_ROWS;
constexpr int TILES = CONV_CHANNELS / 8;   // of eight features
constexpr int PARTS = CONV_CHANNELS / 16;  // of a product over hidden channels or features
constexpr int WORD = 8;                    // numbers in 16 bytes

typedef unsigned short Bits;  // of a bfloat16

extern __shared__ __align__(16) unsigned char shared_memory[];
