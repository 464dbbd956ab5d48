// Copies many pieces of memory in one launch: blocks along x share a piece, blocks along y the
// pieces.
#include "common/constants.h"
#include "constants.h"
#include "params.h"

#define KERNEL extern "C" __global__ void

static_assert(sizeof(CopyAllParams::copies) == MAX_COPIES * sizeof(CopyParams));

KERNEL copy_all(CopyAllParams p) {
    if (p.condition && !*p.condition)
        return;
    const CopyParams& copy = p.copies[blockIdx.y];
    unsigned int n_words = copy.is_aligned ? copy.n_bytes / 16 : 0;
    unsigned int first = blockIdx.x * (BLOCK * COPY_WORDS) + threadIdx.x;
    const uint4* source = (const uint4*)copy.source;
    uint4 words[COPY_WORDS];
#pragma unroll
    for (int i = 0; i < COPY_WORDS; i++)
        if (first + i * BLOCK < n_words)
            words[i] = source[first + i * BLOCK];
#pragma unroll
    for (int i = 0; i < COPY_WORDS; i++)
        if (first + i * BLOCK < n_words)
            ((uint4*)copy.target)[first + i * BLOCK] = words[i];
    // the rest, byte by byte
    for (unsigned int at = 16 * n_words + blockIdx.x * BLOCK + threadIdx.x; at < copy.n_bytes;
         at += gridDim.x * BLOCK)
        ((unsigned char*)copy.target)[at] = ((const unsigned char*)copy.source)[at];
}
