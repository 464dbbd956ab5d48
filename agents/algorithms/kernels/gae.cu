// Generalised advantage estimates, one thread per lane, from the last step to the first.
#include "common/dependent_launch.h"
#include "params.h"

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
