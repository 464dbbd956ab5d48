// As spawn_hidden.cu, with objects.
#include "spawn.h"
#include "whole_warp.h"

KERNEL spawn_hidden_objects(SpawnParams p) {
    wait_for_previous();
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (env < p.scenery.n_envs)
        spawn_env<1, 1>(p, WholeWarp{(int)threadIdx.x % WARP}, env);
}
