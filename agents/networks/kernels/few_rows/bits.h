// What all kernels of this folder share.
#pragma once

#define BOUNDS(n_threads) __launch_bounds__(n_threads)

typedef unsigned short Bits;  // of a bfloat16
