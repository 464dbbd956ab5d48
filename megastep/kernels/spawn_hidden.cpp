// A loop over environments.
#include "spawn.h"

KERNEL spawn_hidden(const SpawnParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.scenery.n_threads)
    for (int env = 0; env < p.scenery.n_envs; env++)
        if (p.objects.n_objects)
            spawn_env<1, 1>(p, SingleThread{0}, env);
        else
            spawn_env<1, 0>(p, SingleThread{0}, env);
}

KERNEL spawn_hidden_objects(const SpawnParams& p) { spawn_hidden(p); }
