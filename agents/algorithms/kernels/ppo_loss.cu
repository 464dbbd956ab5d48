// PPO's loss, with its gradients and metrics, all means over valid rows. One thread per row; a
// block adds up its rows in a fixed order, the caller the blocks.
#include "common/sums.h"
#include "params.h"

KERNEL ppo_loss(PpoLossParams p) {
    wait_for_previous();
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    float sums[N_SUMS] = {};
    float clip = *p.clip, value_coef = *p.value_coef;
    float entropy_coef = *p.entropy_coef, auxiliary_coef = *p.auxiliary_coef;
    if (row < p.n_rows) {
        float weight = p.valid[row] ? 1.f / (float)max(*p.n_valid, 1ll) : 0.f;
        float d_logprob = 0.f, d_value = 0.f;
        if (p.valid[row]) {
            float log_ratio = p.logprobs[row] - p.old_logprobs[row], ratio = expf(log_ratio);
            float clipped = fminf(fmaxf(ratio, 1.f - clip), 1.f + clip);
            float advantage = p.advantages[row], surrogate = ratio * advantage;
            float scale = *p.value_scale, error = (p.values[row] - p.targets[row]) / scale;
            // a NaN fails both comparisons and stays
            bool is_clipped = surrogate > clipped * advantage;
            float squared = error * error;
            bool is_limited = false;
            if (p.old_values) {
                float limit = p.value_clip * scale, old = p.old_values[row];
                float moved = p.values[row] - old;
                float clipped_error =
                    (old + fminf(fmaxf(moved, -limit), limit) - p.targets[row]) / scale;
                if (clipped_error * clipped_error > squared) {
                    is_limited = fabsf(moved) > limit;
                    squared = clipped_error * clipped_error;
                }
            }
            d_logprob = is_clipped ? 0.f : -surrogate * weight;
            d_value = is_limited ? 0.f : value_coef * 2.f * error / scale * weight;
            sums[0] = -(is_clipped ? clipped * advantage : surrogate);
            sums[1] = squared;
            sums[2] = p.entropies[row];
            sums[3] = ratio - 1.f - log_ratio;
            sums[4] = ratio != clipped ? 1.f : 0.f;
            sums[5] = p.errors ? p.errors[row] : 0.f;
            sums[6] =
                sums[0] + value_coef * sums[1] - entropy_coef * sums[2] + auxiliary_coef * sums[5];
            for (int i = 0; i < N_SUMS; i++)
                sums[i] *= weight;
        }
        p.d_logprobs[row] = d_logprob;
        p.d_values[row] = d_value;
        p.d_entropies[row] = -entropy_coef * weight;
        if (p.errors)
            p.d_errors[row] = auxiliary_coef * weight;
    }
    add_up<BLOCK>(sums, p.sums + blockIdx.x * N_SUMS);
}
