// One thread per environment.
#include "spawn.h"

KERNEL spawn(SpawnParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.scenery.n_envs)
        spawn_env<0, 0>(p, SingleThread{0}, env);
}
