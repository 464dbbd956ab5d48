// The backend's spelling of what the common headers leave open: HD (how a function is declared),
// ALIGNED, LOAD, OR_BITS, ADD, COUNT_BITS, HALF_BITS, HALF_VALUE, NAN_VALUE, INF_VALUE, and of
// floats SQRT, CEIL, FLOOR, RINT and RECIPROCAL, all correctly rounded. RECIPROCAL is so only where
// it and its argument lie well within what a float can hold; elsewhere it may be anything.
//
// CPU and GPU agree on every bit. Hence no fused multiply-add (a compiler flag on either side),
// IEEE division and square root, and a sine and cosine of our own.
#pragma once
#ifdef __CUDACC__
#include "backend_cuda.h"
#else
#include "backend_cpu.h"
#endif
