// Categorical actions: choosing them when acting, one warp per lane; log-probability and entropy when
// learning, and their gradients, one thread per row.
#include "lanes.h"
#include "params.h"

constexpr unsigned int ALL_LANES = ~0u;

DEVICE float sum_of_warp(float x) {
    for (int mask = WARP / 2; mask; mask /= 2)
        x += __shfl_xor_sync(ALL_LANES, x, mask);
    return x;
}

template <class T>
DEVICE float rounded(float x) {
    T value;
    assign(value, x);
    return to_float(value);
}

// The score of each choice of an agent, that of choice k in lane k; others have -infinity.
template <class T>
DEVICE float score_of(const CategoricalActParams& p, long long policy, long long row, int agent,
                      int lane) {
    constexpr int AT_ONCE = 8;  // choices, so that their loads do not wait for each other
    float score = __int_as_float(0xff800000);
    long long first_choice = (policy * p.n_agents + agent) * p.n_choices;
    for (int start = 0; start < p.n_choices; start += AT_ONCE) {
        float sums[AT_ONCE] = {};
        for (int first = 4 * lane; first < p.width; first += 4 * WARP) {
            float features[4];
            read<T>(features, p.features, row * p.width + first);
#pragma unroll
            for (int k = 0; k < AT_ONCE; k++) {
                float weights[4];
                long long choice = first_choice + min(start + k, p.n_choices - 1);
                read<T>(weights, p.weight, choice * p.width + first);
#pragma unroll
                for (int n = 0; n < 4; n++)
                    sums[k] += features[n] * weights[n];
            }
        }
#pragma unroll
        for (int k = 0; k < AT_ONCE; k++) {
            float sum = sum_of_warp(sums[k]);
            if (lane == start + k && lane < p.n_choices)
                score = rounded<T>(sum + to_float(((const T*)p.bias)[first_choice + lane]));
        }
    }
    return score;
}

// Logits are log-softmax of the scores. Samples by the Gumbel-max trick.
template <class T>
DEVICE void act(const CategoricalActParams& p) {
    int i = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, lane = threadIdx.x % WARP;
    if (i >= p.n_lanes)
        return;
    long long policy = blockIdx.y, row = policy * p.n_lanes + i;
    float logprob = 0.f;
    for (int agent = 0; agent < p.n_agents; agent++) {
        float score = score_of<T>(p, policy, row, agent, lane), largest = score;
        for (int mask = WARP / 2; mask; mask /= 2)
            largest = fmaxf(largest, __shfl_xor_sync(ALL_LANES, largest, mask));
        bool is_choice = lane < p.n_choices;
        float total = sum_of_warp(is_choice ? expf(score - largest) : 0.f);
        float logit = score - largest - logf(total), value = logit;
        long long at = (row * p.n_agents + agent) * p.n_choices + lane;
        if (is_choice) {
            p.logits[at] = logit;
            if (p.noise)
                value -= logf(fmaxf(p.noise[at], 1e-20f));
        }
        int best = lane;
        for (int mask = WARP / 2; mask; mask /= 2) {
            float other = __shfl_xor_sync(ALL_LANES, value, mask);
            int other_best = __shfl_xor_sync(ALL_LANES, best, mask);
            if (other > value || (other == value && other_best < best)) {
                value = other;
                best = other_best;
            }
        }
        best = __shfl_sync(ALL_LANES, best, 0);
        best = best < p.n_choices ? best : 0;  // if every score is NaN
        logprob += __shfl_sync(ALL_LANES, logit, best);
        if (!lane)
            p.actions[row * p.n_agents + agent] = best;
    }
    if (!lane)
        p.logprobs[row] = logprob;
}

KERNEL categorical_act_float32(CategoricalActParams p) { act<float>(p); }
KERNEL categorical_act_bfloat16(CategoricalActParams p) { act<Bfloat16>(p); }

KERNEL categorical_terms(CategoricalTermsParams p) {
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    if (row >= p.n_rows)
        return;
    float logprob = 0.f, entropy = 0.f;
    for (int agent = 0; agent < p.n_agents; agent++) {
        long long first = (long long)row * p.n_agents + agent;
        const float* logits = p.logits + first * p.n_choices;
        logprob += logits[p.actions[first]];
        for (int k = 0; k < p.n_choices; k++)
            entropy -= expf(logits[k]) * logits[k];
    }
    p.logprobs[row] = logprob;
    p.entropies[row] = entropy;
}

KERNEL categorical_terms_backward(CategoricalTermsBackwardParams p) {
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    if (row >= p.n_rows)
        return;
    float d_logprob = p.d_logprobs[row], d_entropy = p.d_entropies[row];
    for (int agent = 0; agent < p.n_agents; agent++) {
        long long first = (long long)row * p.n_agents + agent;
        const float* logits = p.logits + first * p.n_choices;
        float* d_logits = p.d_logits + first * p.n_choices;
        for (int k = 0; k < p.n_choices; k++)
            d_logits[k] = (p.actions[first] == k ? d_logprob : 0.f) -
                          d_entropy * expf(logits[k]) * (logits[k] + 1.f);
    }
}
