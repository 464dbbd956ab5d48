// A loop over environments.
#include "deathmatch_step.h"

KERNEL deathmatch_step(const DeathmatchStepParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++)
        deathmatch_env(p, env);
}
