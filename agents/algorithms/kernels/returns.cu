// Returns and advantages, one thread per lane, from the last step to the first.
#include "common/dependent_launch.h"
#include "params.h"

// Generalised advantage estimation.
KERNEL gae(GaeParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane >= p.n_lanes)
        return;
    float advantage = 0.f, next_value = p.last_value[lane];
    float gamma = *p.gamma, lambda_ = *p.lambda_;
#pragma unroll 4
    for (int t = p.n_steps - 1; t >= 0; t--) {
        long long at = t * (long long)p.n_lanes + lane;
        float value = p.values[at];
        bool reset = p.reset[at], terminal = p.terminal[at], truncated = p.truncated[at];
        float delta = p.reward[at] + gamma * (terminal ? 0.f : next_value) - value;
        bool ends = terminal || truncated || reset;
        advantage = (reset ? 0.f : delta) + (ends ? 0.f : gamma * lambda_ * advantage);
        p.advantages[at] = advantage;
        p.targets[at] = advantage + value;
        p.valid[at] = !reset && (!p.learns || p.learns[at]);
        next_value = value;
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
