// Returns and advantages, one thread per lane, from the last step to the first.
#include "common/dependent_launch.h"
#include "params.h"

constexpr int STEPS = 16;  // that a thread reads at once

// Generalised advantage estimation.
KERNEL gae(GaeParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane >= p.n_lanes)
        return;
    float advantage = 0.f, next_value = p.last_value[lane];
    float gamma = *p.gamma, lambda_ = *p.lambda_;
    // Steps are read together, before a write that might be to what they read.
    for (int last = p.n_steps - 1; last >= 0; last -= STEPS) {
        float rewards[STEPS], values[STEPS];
        bool resets[STEPS], terminals[STEPS], truncations[STEPS], valid[STEPS];
        for (int i = 0; i < STEPS; i++) {
            long long at = max(last - i, 0) * (long long)p.n_lanes + lane;
            rewards[i] = p.reward[at];
            values[i] = p.values[at];
            resets[i] = p.reset[at];
            terminals[i] = p.terminal[at];
            truncations[i] = p.truncated[at];
            valid[i] = !p.learns || p.learns[at];
        }
        for (int i = 0; i < STEPS; i++) {
            if (i > last)
                break;
            long long at = (last - i) * (long long)p.n_lanes + lane;
            float value = values[i];
            float delta = rewards[i] + gamma * (terminals[i] ? 0.f : next_value) - value;
            bool ends = terminals[i] || truncations[i] || resets[i];
            advantage = (resets[i] ? 0.f : delta) + (ends ? 0.f : gamma * lambda_ * advantage);
            p.advantages[at] = advantage;
            p.targets[at] = advantage + value;
            p.valid[at] = !resets[i] && valid[i];
            next_value = value;
        }
    }
}

KERNEL vtrace(VtraceParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane >= p.n_lanes)
        return;
    float next_value = p.values[p.n_steps * (long long)p.n_lanes + lane];
    float next_target = next_value, correction = 0.f;  // of the value, v - V
    float gamma = *p.gamma, lambda_ = *p.lambda_, rho_clip = *p.rho_clip, c_clip = *p.c_clip;
#pragma unroll 4
    for (int t = p.n_steps - 1; t >= 0; t--) {
        long long at = t * (long long)p.n_lanes + lane;
        float value = p.values[at], reward = p.reward[at], ratio = expf(p.log_ratio[at]);
        bool reset = p.reset[at], terminal = p.terminal[at], truncated = p.truncated[at];
        // a NaN stays
        float rho = ratio > rho_clip ? rho_clip : ratio;
        float c = ratio > c_clip ? c_clip : ratio;
        float delta = rho * (reward + gamma * (terminal ? 0.f : next_value) - value);
        float beyond = terminal ? 0.f : truncated ? next_value : next_target;
        p.advantages[at] = reset ? 0.f : rho * (reward + gamma * beyond - value);
        bool ends = terminal || truncated || reset;
        correction = (reset ? 0.f : delta) + (ends ? 0.f : gamma * lambda_ * c * correction);
        next_target = value + correction;
        p.targets[at] = next_target;
        next_value = value;
    }
}
