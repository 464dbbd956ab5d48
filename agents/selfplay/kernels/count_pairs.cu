// Adds up rewards, and counts the pairs of agents that a step decides: one thread per environment.
#include "common/dependent_launch.h"
#include "params.h"

KERNEL count_pairs(CountPairsParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env >= p.n_envs)
        return;
    long long first = (long long)env * p.n_agents, slot = first + p.slots[env];
    float own = p.returns[slot] + p.reward[slot], won = 0.f, decided = 0.f;
    bool dies = p.terminal[slot];
    for (long long i = first; i < first + p.n_agents; i++) {
        float total = p.returns[i] + p.reward[i];
        bool other_dies = p.terminal[i];
        p.returns[i] = other_dies || p.truncated[i] ? 0.f : total;
        if (i == slot || !(dies || other_dies))
            continue;
        decided += 1.f;
        if (dies != other_dies)
            won += other_dies ? 1.f : 0.f;
        else
            won += own > total ? 1.f : own < total ? 0.f : .5f;
    }
    p.pairs[env] += won;
    p.pairs[p.n_envs + env] += decided;
}
