// A loop over environments.
#include "spawn.h"

template <int hidden>
static void spawn_all(const SpawnParams& p, int min_parallel) {
    const SceneryParams& s = p.scenery;
    int n_threads = threads_for(s, s.n_envs * s.n_agents, min_parallel);
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int env = 0; env < s.n_envs; env++)
        if (p.objects.n_objects)
            spawn_env<hidden, 1>(p, SingleThread{0}, env);
        else
            spawn_env<hidden, 0>(p, SingleThread{0}, env);
}

KERNEL spawn(const SpawnParams& p) { spawn_all<0>(p, 1 << 14); }  // agents, few of which respawn
KERNEL spawn_objects(const SpawnParams& p) { spawn_all<0>(p, 1 << 14); }
KERNEL spawn_hidden(const SpawnParams& p) { spawn_all<1>(p, 0); }
KERNEL spawn_hidden_objects(const SpawnParams& p) { spawn_all<1>(p, 0); }
