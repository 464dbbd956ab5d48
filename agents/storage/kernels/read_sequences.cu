// Reads sequences from the replay buffer, one thread per word. The first block computes the
// importance weights, the next ones read the flags, then those of each tensor follow.
#include "common/backend.h"
#include "common/sums.h"
#include "params.h"

struct Start {
    unsigned int slot, lane;
};

DEVICE Start start_of(const ReadSequencesParams& p, unsigned int sequence) {
    unsigned int index = (unsigned int)p.index[sequence];
    return {index / p.n_lanes, index % p.n_lanes};
}

// The number of the entry (row, lane) of a ring's row that is t rows after the sequence's first.
DEVICE long long entry(const ReadSequencesParams& p, unsigned int sequence, unsigned int t,
                       unsigned int rows_per_rollout) {
    Start start = start_of(p, sequence);
    unsigned int n_rows = p.n_rollouts * rows_per_rollout;
    unsigned int row = start.slot * rows_per_rollout + t;  // t is at most n_rows
    return (long long)(row < n_rows ? row : row - n_rows) * p.n_lanes + start.lane;
}

template <class Word>
DEVICE void copy_word(const ReadTensorParams& tensor, unsigned int at, long long from) {
    ((Word*)tensor.target)[at] = ((const Word*)tensor.source)[from];
}

DEVICE void read_word(const ReadSequencesParams& p, const ReadTensorParams& tensor,
                      unsigned int at) {
    unsigned int row = at / tensor.n_words, word = at % tensor.n_words;
    unsigned int t = row / p.n_sequences, sequence = row % p.n_sequences;
    if (t >= tensor.n_rows)
        return;
    long long from = entry(p, sequence, t, tensor.rows_per_rollout) * tensor.n_words + word;
    if (tensor.word_size == 16)
        copy_word<uint4>(tensor, at, from);
    else if (tensor.word_size == 8)
        copy_word<uint2>(tensor, at, from);
    else if (tensor.word_size == 4)
        copy_word<unsigned int>(tensor, at, from);
    else if (tensor.word_size == 2)
        copy_word<unsigned short>(tensor, at, from);
    else if (tensor.word_size == 1)
        copy_word<unsigned char>(tensor, at, from);
    else
        ((float*)tensor.target)[at] = HALF_VALUE(((const unsigned short*)tensor.source)[from]);
}

DEVICE void read_flags(const ReadSequencesParams& p, unsigned int at) {
    unsigned int t = at / p.n_sequences;
    if (t >= p.n_steps + 1)
        return;
    unsigned int flags = p.flags[entry(p, at % p.n_sequences, t, p.rows_per_rollout)];
    p.starts[at] = flags & 1;
    p.learns[at] = flags >> 1 & 1;
    if (t < p.n_steps) {
        p.terminal[at] = flags >> 2 & 1;
        p.truncated[at] = flags >> 3 & 1;
    }
}

// One block
DEVICE void read_weights(const ReadSequencesParams& p) {
    double largest = 0.;
    for (unsigned int i = threadIdx.x; i < p.n_sequences; i += blockDim.x) {
        double ratio = (double)*p.n_available * p.probability[i];
        double weight = pow(ratio < 1e-30 ? 1e-30 : ratio, -(double)p.beta);
        p.weights[i] = weight;
        largest = fmax(largest, weight);
        long long age = *p.n_added - 1 - start_of(p, i).slot, n = p.n_rollouts;
        p.age[i] = (age % n + n) % n;
    }
    largest = largest_of_block<READ_THREADS>(largest);
    for (unsigned int i = threadIdx.x; i < p.n_sequences; i += blockDim.x)
        p.weight[i] = (float)(p.weights[i] / largest);
}

KERNEL read_sequences(ReadSequencesParams p) {
    wait_for_previous();
    unsigned int block = blockIdx.x;
    if (!block) {
        read_weights(p);
        return;
    }
    int number = (int)p.n_tensors - 1;
    while (number >= 0 && block < p.tensors[number].first_block)
        number--;
    unsigned int first = number < 0 ? 1 : p.tensors[number].first_block;
    unsigned int at = (block - first) * blockDim.x + threadIdx.x;
    if (number < 0)
        read_flags(p, at);
    else
        read_word(p, p.tensors[number], at);
}
