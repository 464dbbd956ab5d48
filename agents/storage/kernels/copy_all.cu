// Copies many pieces of memory in one launch. A block copies neighbouring words of one piece.
#include "common/constants.h"
#include "common/rows.h"
#include "params.h"

constexpr unsigned int BLOCK_BYTES = 16 * BLOCK * COPY_WORDS;

static_assert(sizeof(CopyAllParams::copies) == MAX_COPIES * sizeof(CopyParams));

KERNEL copy_all(CopyAllParams p) {
    wait_for_previous();
    if (p.condition && !*p.condition)
        return;
    const CopyParams& copy = p.copies[row_of_block(p.copies, p.n_copies)];
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
            ((uint4*)copy.target)[first + i * BLOCK] = words[i];
    // the rest, byte by byte
    for (unsigned int at = 16 * n_words + block * BLOCK + threadIdx.x; at < copy.n_bytes;
         at += n_blocks * BLOCK)
        ((unsigned char*)copy.target)[at] = ((const unsigned char*)copy.source)[at];
}
