// Many copies in one launch. A block copies neighbouring words of one piece of memory or tensor, a
// thread several of them, whose loads do not wait for each other.
#include "common/constants.h"
#include "common/rows.h"
#include "params.h"

constexpr unsigned int BLOCK_BYTES = 16 * BLOCK * COPY_WORDS;

KERNEL copy_all(CopyAllParams p) {
    wait_for_previous();
    if (p.condition && !*p.condition)
        return;
    const CopyParams& copy = p.copies[row_of_block(p.copies, p.n_copies)];
    unsigned char* target = (unsigned char*)copy.target + (p.row ? *p.row : 0);
    unsigned int block = blockIdx.x - copy.first_block;
    unsigned int n_blocks = (copy.n_bytes + BLOCK_BYTES - 1) / BLOCK_BYTES;
    unsigned int n_words = copy.is_aligned ? copy.n_bytes / 16 : 0;
    unsigned int first = block * (BLOCK * COPY_WORDS) + threadIdx.x;
    const uint4* source = (const uint4*)copy.source;
    uint4 words[COPY_WORDS];
    for (int i = 0; i < COPY_WORDS; i++)
        if (first + i * BLOCK < n_words)
            words[i] = source[first + i * BLOCK];
    for (int i = 0; i < COPY_WORDS; i++)
        if (first + i * BLOCK < n_words)
            ((uint4*)target)[first + i * BLOCK] = words[i];
    // the rest, byte by byte
    for (unsigned int at = 16 * n_words + block * BLOCK + threadIdx.x; at < copy.n_bytes;
         at += n_blocks * BLOCK)
        target[at] = ((const unsigned char*)copy.source)[at];
    if (!p.row_bytes)
        return;
    __syncthreads();  // all have read where the row is; the last block moves on
    unsigned int* n_done = (unsigned int*)(p.row + 1);
    if (threadIdx.x == 0 && atomicAdd(n_done, 1u) == gridDim.x - 1) {
        *n_done = 0u;
        *p.row += p.row_bytes;
    }
}

// Where either of two flags is set.
KERNEL either(EitherParams p) {
    wait_for_previous();
    int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i < p.n)
        p.out[i] = p.one[i] | p.other[i];
}
