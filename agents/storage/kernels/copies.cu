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

// ---- Of lanes ----

template <class Word>
__device__ void copy_words(const SelectLanesParams& p, const SelectParams& tensor,
                           unsigned int first) {
    const Word* source = (const Word*)tensor.source;
    unsigned int n = tensor.n_steps * p.n_selected * tensor.n_words;
    Word words[COPY_WORDS];
    for (int i = 0; i < COPY_WORDS; i++) {
        unsigned int at = first + i * BLOCK;
        if (at >= n)
            continue;
        unsigned int row = at / tensor.n_words, word = at - row * tensor.n_words;
        unsigned int t = row / p.n_selected, m = row - t * p.n_selected;
        words[i] = source[((long long)t * p.n_lanes + p.lanes[m]) * tensor.n_words + word];
    }
    for (int i = 0; i < COPY_WORDS; i++)
        if (first + i * BLOCK < n)
            ((Word*)tensor.target)[first + i * BLOCK] = words[i];
}

KERNEL select_lanes(SelectLanesParams p) {
    wait_for_previous();
    const SelectParams& tensor = p.tensors[row_of_block(p.tensors, p.n_tensors)];
    unsigned int first = (blockIdx.x - tensor.first_block) * (BLOCK * COPY_WORDS) + threadIdx.x;
    if (tensor.word_size == 16)
        copy_words<uint4>(p, tensor, first);
    else if (tensor.word_size == 8)
        copy_words<uint2>(p, tensor, first);
    else if (tensor.word_size == 4)
        copy_words<unsigned int>(p, tensor, first);
    else
        copy_words<unsigned char>(p, tensor, first);
}
