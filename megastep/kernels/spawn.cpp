// A loop over environments.
#include "spawn.h"

constexpr int MIN_PARALLEL = 1 << 14;  // agents, few of which respawn

KERNEL spawn(const SpawnParams& p) {
    const SceneryParams& s = p.scenery;
    int n_threads = threads_for(s, s.n_envs * s.n_agents, MIN_PARALLEL);
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int env = 0; env < s.n_envs; env++)
        if (p.objects.n_objects)
            spawn_env<0, 1>(p, SingleThread{0}, env);
        else
            spawn_env<0, 0>(p, SingleThread{0}, env);
}

KERNEL spawn_objects(const SpawnParams& p) { spawn(p); }
