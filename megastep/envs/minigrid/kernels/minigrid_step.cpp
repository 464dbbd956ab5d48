#include "minigrid_step.h"

KERNEL minigrid_step(const MiniGridStepParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++)
        minigrid_env(p, env, p.image + 3ll * VIEW * VIEW * env);
}
