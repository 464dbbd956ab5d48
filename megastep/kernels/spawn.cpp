// A loop over environments.
#include "spawn.h"

KERNEL spawn(const SpawnParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.scenery.n_threads)
    for (int env = 0; env < p.scenery.n_envs; env++)
        spawn_env<0>(p, SingleThread{0}, env);
}
