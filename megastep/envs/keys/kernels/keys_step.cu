// One thread per environment.
#include "keys_step.h"

KERNEL keys_step(KeysStepParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.scenery.n_envs)
        keys_env(p, env);
}
