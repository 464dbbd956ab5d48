// Categorical actions: choosing them when acting, ACT_THREADS threads per lane; log-probability and entropy when
// learning, and their gradients, one thread per row.
#include "constants.h"
#include "lanes.h"
#include "params.h"

template <class T>
DEVICE float rounded(float x) {
    T value;
    assign(value, x);
    return to_float(value);
}

// The scores of an agent's choices, in each of the ACT_THREADS threads of a lane.
template <class T>
DEVICE void score(float (&scores)[MAX_CHOICES], const CategoricalActParams& p, int row,
                  const T* weight, const T* bias, int part) {
    for (int k = 0; k < MAX_CHOICES; k++)
        scores[k] = 0.f;
    const T* features = (const T*)p.features + (long long)row * p.width;
    for (int first = 4 * part; first < p.width; first += 4 * ACT_THREADS) {
        float of_lane[4];
        read<T>(of_lane, features, first);
#pragma unroll
        for (int k = 0; k < MAX_CHOICES; k++)
            if (k < p.n_choices) {
                float weights[4];
                read<T>(weights, weight + k * p.width, first);
#pragma unroll
                for (int n = 0; n < 4; n++)
                    scores[k] += of_lane[n] * weights[n];
            }
    }
#pragma unroll
    for (int k = 0; k < MAX_CHOICES; k++) {
        for (int mask = ACT_THREADS / 2; mask; mask /= 2)
            scores[k] += __shfl_xor_sync(~0u, scores[k], mask);
        if (k < p.n_choices)
            scores[k] = rounded<T>(scores[k] + to_float(bias[k]));
    }
}

// Logits are log-softmax of the scores. Samples by the Gumbel-max trick.
template <class T>
DEVICE void act(const CategoricalActParams& p) {
    int thread = blockIdx.x * blockDim.x + threadIdx.x, part = thread % ACT_THREADS;
    int lane = min(thread / ACT_THREADS, p.n_lanes - 1);  // all threads of a warp shuffle
    long long policy = blockIdx.y;
    int row = (int)policy * p.n_lanes + lane;
    float logprob = 0.f;
    for (int agent = 0; agent < p.n_agents; agent++) {
        long long choice = (policy * p.n_agents + agent) * p.n_choices;
        float scores[MAX_CHOICES];
        score<T>(scores, p, row, (const T*)p.weight + choice * p.width,
                 (const T*)p.bias + choice, part);
        float largest = scores[0], total = 0.f;
#pragma unroll
        for (int k = 1; k < MAX_CHOICES; k++)
            if (k < p.n_choices)
                largest = fmaxf(largest, scores[k]);
#pragma unroll
        for (int k = 0; k < MAX_CHOICES; k++)
            if (k < p.n_choices)
                total += expf(scores[k] - largest);
        float log_total = logf(total), best_value = 0.f, best_logit = 0.f;
        long long at = ((long long)row * p.n_agents + agent) * p.n_choices;
        int best = 0;
#pragma unroll
        for (int k = 0; k < MAX_CHOICES; k++)
            if (k < p.n_choices) {
                float logit = scores[k] - largest - log_total, value = logit;
                if (part == k)
                    p.logits[at + k] = logit;
                if (p.noise)
                    value -= logf(fmaxf(p.noise[at + k], 1e-20f));
                if (!k || value > best_value) {
                    best = k;
                    best_value = value;
                    best_logit = logit;
                }
            }
        logprob += best_logit;
        if (!part)
            p.actions[(long long)row * p.n_agents + agent] = best;
    }
    if (!part)
        p.logprobs[row] = logprob;
}

KERNEL BOUNDS(64) categorical_act_float32(CategoricalActParams p) { act<float>(p); }
KERNEL BOUNDS(64) categorical_act_bfloat16(CategoricalActParams p) { act<Bfloat16>(p); }

KERNEL BOUNDS(64) categorical_terms(CategoricalTermsParams p) {
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

KERNEL BOUNDS(64) categorical_terms_backward(CategoricalTermsBackwardParams p) {
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
