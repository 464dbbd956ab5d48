// Choosing categorical actions, ACT_THREADS threads per lane.
#include "common/sums.h"
#include "common/numbers.h"
#include "params.h"

template <class T>
DEVICE float rounded(float x) {
    T value;
    assign(value, x);
    return to_float(value);
}

DEVICE float largest_of_lane(float x) {
    for (int mask = ACT_THREADS / 2; mask; mask /= 2)
        x = fmaxf(x, __shfl_xor_sync(~0u, x, mask));
    return x;
}

// The score of choice `part` of an agent, before the bias. The threads of a lane share its
// features. Nothing branches on the number of choices, so that no load waits for another.
template <class T>
DEVICE float score_of(const CategoricalActParams& p, const T* features, const T* weight, int part) {
    constexpr int N = 16 / sizeof(T);  // numbers that a thread reads at once
    float sums[ACT_THREADS] = {};
    for (int first = N * part; first < p.width; first += N * ACT_THREADS) {
        float of_lane[N];
        read<T>(of_lane, features, first);
        for (int k = 0; k < ACT_THREADS; k++) {
            float weights[N];
            read<T>(weights, weight, min(k, p.n_choices - 1) * p.width + first);
            for (int n = 0; n < N; n++)
                sums[k] += of_lane[n] * weights[n];
        }
    }
    float score = 0.f;
    for (int k = 0; k < ACT_THREADS; k++) {
        float sum = sum_of_threads<ACT_THREADS>(sums[k]);
        score = k == part ? sum : score;
    }
    return score;
}

// Thread k of a lane handles choice k of each agent. Logits are log-softmax of the scores; samples
// by the Gumbel-max trick.
template <class T>
DEVICE void act(const CategoricalActParams& p) {
    int thread = blockIdx.x * blockDim.x + threadIdx.x, part = thread % ACT_THREADS;
    int lane = min(thread / ACT_THREADS, p.n_lanes - 1);  // all threads of a warp shuffle
    long long row = lane;
    bool is_choice = part < p.n_choices;
    float infinity = __int_as_float(0x7f800000), logprob = 0.f;
    for (int agent = 0; agent < p.n_agents; agent++) {
        int choice = agent * p.n_choices;
        long long at = (row * p.n_agents + agent) * p.n_choices + part;
        float noise = p.noise && is_choice ? p.noise[at] : 1.f;
        float bias = to_float(((const T*)p.bias)[choice + min(part, p.n_choices - 1)]);
        float score = score_of(p, (const T*)p.features + row * p.width,
                               (const T*)p.weight + (long long)choice * p.width, part);
        score = is_choice ? rounded<T>(score + bias) : -infinity;
        float largest = largest_of_lane(score);
        float total = sum_of_threads<ACT_THREADS>(is_choice ? expf(score - largest) : 0.f);
        float logit = score - largest - logf(total);
        float value = logit - logf(fmaxf(noise, 1e-20f));
        if (is_choice)
            p.logits[at] = logit;
        // the largest value's choice, the first of equal ones; 0 if all are NaN
        float best_value = largest_of_lane(is_choice ? value : -infinity);
        unsigned int is_best = __ballot_sync(~0u, is_choice && value == best_value);
        unsigned int of_lane = is_best >> (threadIdx.x % WARP - part) & ((1u << ACT_THREADS) - 1);
        int best = of_lane ? __ffs(of_lane) - 1 : 0;
        logprob += __shfl_sync(~0u, logit, best, ACT_THREADS);
        if (!part)
            p.actions[row * p.n_agents + agent] = best;
    }
    if (!part)
        p.logprobs[row] = logprob;
}

INSTANCE(__launch_bounds__(64) categorical_act_float32, CategoricalActParams, act<float>)
INSTANCE(__launch_bounds__(64) categorical_act_bfloat16, CategoricalActParams, act<Bfloat16>)
