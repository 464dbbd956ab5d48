// How both kernels of the encoder `Conv` are divided among threads: a block handles tiles of rows.
#pragma once
#include "common/tensor_cores.h"
#include "params.h"

constexpr int THREADS = CONV_THREADS, WARPS = THREADS / 32, ROWS = CONV_ROWS;
constexpr int TILES = CONV_CHANNELS / 8;   // of eight features
constexpr int PARTS = CONV_CHANNELS / 16;  // of a product over hidden channels or features
constexpr int WORD = 8;                    // numbers in 16 bytes

extern __shared__ __align__(16) unsigned char shared_memory[];
