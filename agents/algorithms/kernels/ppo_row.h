// PPO's loss of a row, with its gradients, and its shares of means over valid rows.
#pragma once
#include "common/sums.h"
#include "params.h"

struct RowLoss {
    float weight;  // of the row; 0: not valid
    float d_logprob, d_value, d_entropy;
    float sums[N_SUMS];
};

DEVICE RowLoss loss_of(const PpoParams& p, int row, float logprob, float entropy, float value,
                       float auxiliary) {
    float clip = *p.clip, value_coef = *p.value_coef;
    float entropy_coef = *p.entropy_coef, auxiliary_coef = *p.auxiliary_coef;
    RowLoss loss = {};
    if (!p.valid[row])
        return loss;
    loss.weight = 1.f / (float)max(*p.n_valid, 1ll);
    float log_ratio = logprob - p.old_logprobs[row], ratio = expf(log_ratio);
    float clipped = fminf(fmaxf(ratio, 1.f - clip), 1.f + clip);
    float advantage = p.advantages[row], surrogate = ratio * advantage;
    float scale = *p.value_scale, error = (value - p.targets[row]) / scale;
    // a NaN fails both comparisons and stays
    bool is_clipped = surrogate > clipped * advantage;
    float squared = error * error;
    bool is_limited = false;
    if (p.old_values) {
        float limit = p.value_clip * scale, old = p.old_values[row];
        float moved = value - old;
        float clipped_error = (old + fminf(fmaxf(moved, -limit), limit) - p.targets[row]) / scale;
        if (clipped_error * clipped_error > squared) {
            is_limited = fabsf(moved) > limit;
            squared = clipped_error * clipped_error;
        }
    }
    loss.d_logprob = is_clipped ? 0.f : -surrogate * loss.weight;
    loss.d_value = is_limited ? 0.f : value_coef * 2.f * error / scale * loss.weight;
    loss.d_entropy = -entropy_coef * loss.weight;
    float* sums = loss.sums;
    sums[0] = -(is_clipped ? clipped * advantage : surrogate);
    sums[1] = squared;
    sums[2] = entropy;
    sums[3] = ratio - 1.f - log_ratio;
    sums[4] = ratio != clipped ? 1.f : 0.f;
    sums[5] = auxiliary;
    sums[6] = sums[0] + value_coef * sums[1] - entropy_coef * sums[2] + auxiliary_coef * sums[5];
    for (int i = 0; i < N_SUMS; i++)
        sums[i] *= loss.weight;
    return loss;
}
