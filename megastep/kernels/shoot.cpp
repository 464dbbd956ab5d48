// A loop over environments.
#include "shoot.h"

KERNEL shoot(const ShootParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++)
        shoot_env(p, env);
}
