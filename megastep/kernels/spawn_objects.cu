// As spawn.cu, with objects.
#include "spawn.h"

KERNEL spawn_objects(SpawnParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.scenery.n_envs)
        spawn_env<0, 1>(p, SingleThread{0}, env);
}
