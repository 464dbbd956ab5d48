// One warp per environment: each warp lane tests one wall at a time.
#include "spawn.h"
#include "whole_warp.h"

KERNEL spawn_hidden(SpawnParams p) {
    wait_for_previous();
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (env < p.scenery.n_envs)
        spawn_env<1, 0>(p, WholeWarp{(int)threadIdx.x % WARP}, env);
}
