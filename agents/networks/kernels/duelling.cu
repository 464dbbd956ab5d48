// Action values of a duelling network from its hidden layer (features of the value, then those of
// the advantages), their gradients, and epsilon-greedy actions. An agent's value is the lane's
// value plus its advantage minus the mean over the choices.
#include "common/numbers.h"
#include "params.h"

constexpr int OUTPUTS = DUELLING_OUTPUTS;   // at most, A n
constexpr int ROWS = WARP / OUTPUTS;        // that a warp handles at once
constexpr int STRIP_ROWS = DUELLING_STRIP;  // that a block of the backward pass adds up
constexpr int N = 16 / sizeof(Bfloat16);    // numbers that a thread reads at once

// ---- Forward ----

// Sums over the warp: thread i returns that of sums[i].
DEVICE float sum_of_own(float (&sums)[WARP]) {
    int lane = threadIdx.x % WARP;
    for (int half = WARP / 2; half; half /= 2)
#pragma unroll
        for (int i = 0; i < half; i++) {
            bool is_upper = lane & half;
            float kept = is_upper ? sums[i + half] : sums[i];
            float sent = is_upper ? sums[i] : sums[i + half];
            sums[i] = kept + __shfl_xor_sync(~0u, sent, half);
        }
    return sums[0];
}

// The products of half of the hidden layer, from `offset`, with `n_outputs` rows of a weight.
// Thread OUTPUTS i + k returns that of row i and output k.
DEVICE float products(const DuellingForwardParams& p, const long long (&rows)[ROWS], int offset,
                      const float* weight, int n_outputs) {
    float sums[WARP] = {};
    for (int first = N * (threadIdx.x % WARP); first < p.width; first += N * WARP) {
        float hidden[ROWS][N];
        for (int i = 0; i < ROWS; i++)
            read<Bfloat16>(hidden[i], p.hidden, rows[i] * (2 * p.width) + offset + first);
#pragma unroll
        for (int k = 0; k < OUTPUTS; k++)
            if (k < n_outputs) {
                float weights[N];
                read_eight(weights, weight + k * p.width + first);
                for (int i = 0; i < ROWS; i++)
                    for (int n = 0; n < N; n++)
                        sums[OUTPUTS * i + k] += hidden[i][n] * weights[n];
            }
    }
    return sum_of_own(sums);
}

// A warp's rows, and what a thread of it handles: output `part` of row `row`.
struct Part {
    long long rows[ROWS], row;
    int part, agent;
    bool exists;
};

DEVICE Part find_part(const DuellingForwardParams& p) {
    int lane = threadIdx.x % WARP, n_outputs = p.n_agents * p.n_choices;
    int first = (blockIdx.x * blockDim.x + threadIdx.x) / WARP * ROWS;
    Part part;
    for (int i = 0; i < ROWS; i++)
        part.rows[i] = min(first + i, p.n_rows - 1);
    part.row = first + lane / OUTPUTS;
    part.part = lane % OUTPUTS;
    part.exists = first + lane / OUTPUTS < p.n_rows && part.part < n_outputs;
    part.agent = min(part.part, n_outputs - 1) / p.n_choices;
    return part;
}

// The value of the thread's choice. Writes it, too.
DEVICE float value_of(const DuellingForwardParams& p, const Part& me) {
    int n_outputs = p.n_agents * p.n_choices, last = n_outputs - 1;
    float value = products(p, me.rows, 0, p.value_weight, p.n_agents);
    float advantage = products(p, me.rows, p.width, p.advantage_weight, n_outputs);
    advantage += p.advantage_bias[min(me.part, last)];
    value = __shfl_sync(~0u, value, me.agent, OUTPUTS) + p.value_bias[me.agent];
    float sum = 0.f;
    for (int k = 0; k < OUTPUTS; k++) {
        float other = __shfl_sync(~0u, advantage, k, OUTPUTS);
        sum += k / p.n_choices == me.agent && k < n_outputs ? other : 0.f;
    }
    value += advantage - sum / (float)p.n_choices;
    if (me.exists)
        p.values[me.row * n_outputs + me.part] = value;
    return value;
}

KERNEL __launch_bounds__(64) duelling_values(DuellingForwardParams p) {
    wait_for_previous();
    value_of(p, find_part(p));
}

KERNEL __launch_bounds__(64) duelling_act(DuellingForwardParams p) {
    wait_for_previous();
    Part me = find_part(p);
    float value = value_of(p, me), best_value = 0.f, logprob = 0.f;
    int best = -1, n_outputs = p.n_agents * p.n_choices, agent = me.agent;
    for (int k = 0; k < OUTPUTS; k++) {  // the first of the best choices of this thread's agent
        float other = __shfl_sync(~0u, value, k, OUTPUTS);
        if (k / p.n_choices == agent && k < n_outputs && (best < 0 || other > best_value)) {
            best = k % p.n_choices;
            best_value = other;
        }
    }
    int action = best;
    bool is_first = me.exists && me.part % p.n_choices == 0;  // of its agent
    if (p.noise && is_first) {
        long long at = me.row * p.n_agents + agent;
        float epsilon = p.epsilon ? p.epsilon[me.row] : p.usual_epsilon;
        if (p.noise[(long long)p.n_rows * p.n_agents + at] < epsilon)
            action = min((int)(p.noise[at] * (float)p.n_choices), p.n_choices - 1);
    }
    if (is_first)
        p.actions[me.row * p.n_agents + agent] = action;
    float chance = p.usual_epsilon / (float)p.n_choices;
    chance += action == best ? 1.f - p.usual_epsilon : 0.f;
    float own = is_first ? logf(chance) : 0.f;
    for (int k = 0; k < OUTPUTS; k++)
        logprob += __shfl_sync(~0u, own, k, OUTPUTS);
    if (me.exists && !me.part)
        p.logprobs[me.row] = logprob;
}

// ---- Backward ----

// The gradients of a row's values and centred advantages.
struct RowGradient {
    float value[OUTPUTS], advantage[OUTPUTS];
};

// A thread handles two neighbouring columns of the hidden layer, which have `n_outputs` of at most
// K outputs: it masks their gradient and adds up the rows.
template <int K>
DEVICE void gradient_of_columns(const DuellingBackwardParams& p, const RowGradient* gradients,
                                bool is_value, int column, int n_outputs, const float* weight,
                                float* d_weight, float* d_bias) {
    constexpr int AT_ONCE = 8;  // rows whose loads do not wait
    float weights[K][2], d_weights[K][2], sums[2] = {};
    int in_half = column % p.width;
    for (int k = 0; k < K; k++) {
        clear(d_weights[k]);
        clear(weights[k]);
        if (k < n_outputs)
            read<float>(weights[k], weight, (long long)k * p.width + in_half);
    }
    long long first = (long long)blockIdx.x * STRIP_ROWS;
    int n_rows = min(STRIP_ROWS, p.n_rows - (int)blockIdx.x * STRIP_ROWS);
    for (int start = 0; start < n_rows; start += AT_ONCE) {
        float hidden[AT_ONCE][2];
        for (int i = 0; i < AT_ONCE; i++)
            read<Bfloat16>(hidden[i], p.hidden,
                           (first + min(start + i, n_rows - 1)) * (2 * p.width) + column);
        for (int i = 0; i < AT_ONCE; i++) {
            if (start + i >= n_rows)
                break;
            const RowGradient& row = gradients[start + i];
            const float* d = is_value ? row.value : row.advantage;
            float d_hidden[2] = {};
            for (int k = 0; k < K; k++)
                for (int n = 0; n < 2; n++) {
                    d_hidden[n] += d[k] * weights[k][n];
                    d_weights[k][n] += d[k] * hidden[i][n];
                }
            for (int n = 0; n < 2; n++) {
                d_hidden[n] = hidden[i][n] <= 0.f ? 0.f : d_hidden[n];
                sums[n] += d_hidden[n];
            }
            write<Bfloat16>(p.d_hidden, (first + start + i) * (2 * p.width) + column, d_hidden);
        }
    }
    for (int n = 0; n < 2; n++) {
        d_bias[column + n] = sums[n];
        for (int k = 0; k < K; k++)
            if (k < n_outputs)
                d_weight[(long long)k * p.width + in_half + n] = d_weights[k][n];
    }
}

// A block handles a strip of rows and up to 2 DUELLING_THREADS columns; blocks along y: the parts
// of the columns. A strip's sums are those of the hidden layer's bias, the weights
// of value and advantages, and their biases, in this order.
KERNEL __launch_bounds__(256) duelling_backward(DuellingBackwardParams p) {
    wait_for_previous();
    __shared__ RowGradient gradients[STRIP_ROWS];
    int n_outputs = p.n_agents * p.n_choices, strip = blockIdx.x;
    int n_rows = min(STRIP_ROWS, p.n_rows - strip * STRIP_ROWS);
    long long first = (long long)strip * STRIP_ROWS;
    for (int i = threadIdx.x; i < STRIP_ROWS; i += DUELLING_THREADS) {
        RowGradient gradient = {};
        if (i < n_rows)
            for (int k = 0; k < OUTPUTS; k++) {
                if (k >= n_outputs)
                    break;
                float d = p.d_values[(first + i) * n_outputs + k];
                gradient.advantage[k] = d;
                for (int agent = 0; agent < OUTPUTS; agent++)
                    gradient.value[agent] += k / p.n_choices == agent ? d : 0.f;
            }
        for (int k = 0; k < OUTPUTS; k++)
#pragma unroll
            for (int agent = 0; agent < OUTPUTS; agent++)
                if (k < n_outputs && k / p.n_choices == agent)
                    gradient.advantage[k] -= gradient.value[agent] / (float)p.n_choices;
        gradients[i] = gradient;
    }
    __syncthreads();
    float* d_bias = p.sums + (long long)strip * p.n_sums;
    float* d_value_weight = d_bias + 2 * p.width;
    float* d_advantage_weight = d_value_weight + p.n_agents * p.width;
    float* d_biases = d_advantage_weight + n_outputs * p.width;
    int part = blockIdx.y, column = 2 * (part * DUELLING_THREADS + threadIdx.x);
    bool is_value = column < p.width;
    if (column < 2 * p.width) {
        if (!is_value)
            gradient_of_columns<OUTPUTS>(p, gradients, false, column, n_outputs, p.advantage_weight,
                                         d_advantage_weight, d_bias);
        else if (p.n_agents == 1)
            gradient_of_columns<1>(p, gradients, true, column, 1, p.value_weight, d_value_weight,
                                   d_bias);
        else
            gradient_of_columns<OUTPUTS>(p, gradients, true, column, p.n_agents, p.value_weight,
                                         d_value_weight, d_bias);
    }
    if (!part && threadIdx.x < p.n_agents + n_outputs) {
        float sum = 0.f;
        int k = threadIdx.x;
        for (int i = 0; i < n_rows; i++)
            sum += k < p.n_agents ? gradients[i].value[k] : gradients[i].advantage[k - p.n_agents];
        d_biases[k] = sum;
    }
}
