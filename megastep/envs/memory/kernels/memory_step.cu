// One thread per environment.
#include "memory_step.h"

KERNEL memory_step(MemoryStepParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.scenery.n_envs)
        memory_env(p, env);
}
