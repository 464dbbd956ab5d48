// One thread per environment.
#include "shoot.h"

KERNEL shoot(ShootParams p) {
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.n_envs)
        shoot_env(p, env);
}
