// R2D2's loss with its gradient, priorities and metrics. A block handles a few sequences, a thread
// every N-th step of one of them; the block adds up in a fixed order.
#include "common/sums.h"
#include "params.h"

constexpr int PHASES = TD_THREADS / TD_SEQUENCES;  // threads of a sequence

DEVICE float sign(float x) { return (float)((x > 0.f) - (x < 0.f)); }

// `returns.rescale`
DEVICE float rescale(float x, float eps) {
    return sign(x) * (sqrtf(fabsf(x) + 1.f) - 1.f) + eps * x;
}

// `returns.inverse_rescale`
DEVICE float inverse_rescale(float y, float eps) {
    float size = fabsf(y);
    float root = 2.f * (size + 1.f + eps) / (sqrtf(1.f + 4.f * eps * (size + 1.f + eps)) + 1.f);
    return sign(y) * (root * root - 1.f);
}

// The target network's value of the online network's best actions, in units of reward.
DEVICE float best_value(const TdLossParams& p, long long row) {
    float total = 0.f;
    for (int agent = 0; agent < p.n_agents; agent++) {
        const float* q = p.q + (row * p.n_agents + agent) * p.n_choices;
        int best = 0;
        for (int k = 1; k < p.n_choices; k++)
            best = q[k] > q[best] ? k : best;
        total += p.target_q[(row * p.n_agents + agent) * p.n_choices + best];
    }
    return inverse_rescale(total, p.eps);
}

// `returns.n_step_returns` of step t
DEVICE float n_step_return(const TdLossParams& p, int t, int sequence) {
    float total = 0.f, discount = 1.f;
    for (int s = t; s < p.n_steps; s++) {
        long long row = s * (long long)p.n_sequences + sequence, next = row + p.n_sequences;
        if (p.starts[next])
            return total + discount * p.values[row];
        total += discount * p.reward[row];
        discount *= *p.gamma;
        if (p.terminal[row])
            return total;
        if (p.truncated[row] || s + 1 == t + p.n_return_steps || s + 1 == p.n_steps)
            return total + discount * p.values[next];
    }
    return total;
}

KERNEL td_loss(TdLossParams p) {
    wait_for_previous();
    __shared__ float largest[PHASES][TD_SEQUENCES], sizes[PHASES][TD_SEQUENCES];
    __shared__ float counts[PHASES][TD_SEQUENCES];
    int phase = threadIdx.x / TD_SEQUENCES, of_block = threadIdx.x % TD_SEQUENCES;
    int sequence = blockIdx.x * TD_SEQUENCES + of_block, n_outputs = p.n_agents * p.n_choices;
    bool exists = sequence < p.n_sequences;
    if (exists)
        for (int t = phase; t <= p.n_steps; t += PHASES) {
            long long row = t * (long long)p.n_sequences + sequence;
            p.values[row] = best_value(p, row);
        }
    __syncthreads();
    float sums[N_TD_SUMS] = {}, size = 0.f;
    float weight = exists ? p.weight[sequence] : 0.f;
    if (exists)
        for (int t = phase; t <= p.n_steps; t += PHASES) {
            long long row = t * (long long)p.n_sequences + sequence;
            float d = 0.f;
            bool is_valid = t < p.n_steps && !p.starts[row + p.n_sequences] && p.learns[row];
            if (is_valid) {
                float taken = 0.f;
                for (int agent = 0; agent < p.n_agents; agent++) {
                    long long at = row * p.n_agents + agent;
                    taken += p.q[at * p.n_choices + p.actions[at]];
                }
                float error = rescale(n_step_return(p, t, sequence), p.eps) - taken;
                d = -2.f * weight * error;
                sums[0] += weight * error * error;
                sums[1] += fabsf(error);
                sums[2] += inverse_rescale(taken, p.eps);
                sums[3] += 1.f;
                size = fmaxf(size, fabsf(error));
            }
            for (int k = 0; k < n_outputs; k++) {
                long long at = row * p.n_agents + k / p.n_choices;
                bool is_taken = is_valid && p.actions[at] == k % p.n_choices;
                p.d_q[row * n_outputs + k] = is_taken ? d : 0.f;
            }
        }
    if (exists && !phase) {
        sums[4] = (float)p.age[sequence];
        sums[5] = weight;
        sums[6] = weight * weight;
    }
    largest[phase][of_block] = size;
    sizes[phase][of_block] = sums[1];
    counts[phase][of_block] = sums[3];
    add_up<TD_THREADS>(sums, p.sums + blockIdx.x * N_TD_SUMS);
    if (exists && !phase) {
        float sum = 0.f, count = 0.f;
        for (int i = 0; i < PHASES; i++) {
            size = fmaxf(size, largest[i][of_block]);
            sum += sizes[i][of_block];
            count += counts[i][of_block];
        }
        // a NaN is not the largest, but stays in the sum
        p.priorities[sequence] = p.eta * size + (1.f - p.eta) * (sum / fmaxf(count, 1.f));
    }
}

// Adds up the blocks of `td_loss`, one warp per sum.
KERNEL td_metrics(TdMetricsParams p) {
    wait_for_previous();
    __shared__ float totals[N_TD_SUMS];
    int warp = threadIdx.x / WARP, lane = threadIdx.x % WARP;
    if (warp < N_TD_SUMS) {
        float sum = 0.f;
        for (int block = lane; block < p.n_blocks; block += WARP)
            sum += p.sums[block * N_TD_SUMS + warp];
        sum = sum_of_threads(sum);
        if (!lane)
            totals[warp] = sum;
    }
    __syncthreads();
    if (threadIdx.x)
        return;
    float* metrics = p.metrics;
    float weight = 1.f / fmaxf(totals[3], 1.f), n = (float)p.n_sequences;
    metrics[0] = totals[0] * weight;
    metrics[1] = totals[1] * weight;
    metrics[2] = totals[2] * weight;
    metrics[3] = totals[4] / n;
    float mean = totals[5] / n;
    metrics[4] = mean * mean / fmaxf(totals[6] / n, 1.17549435e-38f);
    metrics[5] = totals[3];
    metrics[6] = weight;
}
