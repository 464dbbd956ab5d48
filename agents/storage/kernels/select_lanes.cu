// Selections of lanes of many tensors in one launch. A thread copies several words, whose loads do
// not wait for each other.
#include "common/constants.h"
#include "common/rows.h"
#include "params.h"

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
