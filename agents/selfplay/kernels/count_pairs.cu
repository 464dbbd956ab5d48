// Adds up rewards, and counts the pairs of agents that a step decides: one thread per environment.
#include "common/dependent_launch.h"
#include "params.h"

KERNEL count_pairs(CountPairsParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env >= p.n_envs)
        return;
    long long first = (long long)env * p.n_agents, end = first + p.n_agents;
    float won = 0.f, decided = 0.f;
    for (long long i = first; i < end; i++)
        p.returns[i] += p.reward[i];
    for (long long i = first; i < end; i++) {
        for (long long j = first; p.own[i] && j < end; j++) {
            bool dies = p.terminal[i], other_dies = p.terminal[j];
            if (p.own[j] || !(dies || other_dies))
                continue;
            float own = p.returns[i], other = p.returns[j];
            decided += 1.f;
            if (dies != other_dies)
                won += other_dies ? 1.f : 0.f;
            else
                won += own > other ? 1.f : own < other ? 0.f : .5f;
        }
    }
    for (long long i = first; i < end; i++)
        p.returns[i] = p.terminal[i] || p.truncated[i] ? 0.f : p.returns[i];
    p.pairs[env] += won;
    p.pairs[p.n_envs + env] += decided;
}
