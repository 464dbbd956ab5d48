// One thread per environment.
#include "deathmatch_step.h"

KERNEL deathmatch_step(DeathmatchStepParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.n_envs)
        deathmatch_env(p, env);
}
