// Selects lanes of many tensors in one launch, one thread per word. Blocks along y: tensors.
#include "common/constants.h"
#include "constants.h"
#include "params.h"

#define KERNEL extern "C" __global__ void

KERNEL select_lanes(SelectLanesParams p) {
    const SelectParams& tensor = p.tensors[blockIdx.y];
    unsigned int at = blockIdx.x * blockDim.x + threadIdx.x;
    unsigned int row = at / tensor.n_words, word = at % tensor.n_words;
    unsigned int t = row / p.n_selected, m = row % p.n_selected;
    if (t >= tensor.n_steps)
        return;
    long long from = ((long long)t * p.n_lanes + p.lanes[m]) * tensor.n_words + word;
    if (tensor.word_size == 16)
        ((uint4*)tensor.target)[at] = ((const uint4*)tensor.source)[from];
    else if (tensor.word_size == 8)
        ((uint2*)tensor.target)[at] = ((const uint2*)tensor.source)[from];
    else if (tensor.word_size == 4)
        ((unsigned int*)tensor.target)[at] = ((const unsigned int*)tensor.source)[from];
    else
        ((unsigned char*)tensor.target)[at] = ((const unsigned char*)tensor.source)[from];
}
