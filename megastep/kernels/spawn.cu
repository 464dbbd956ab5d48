// One thread per environment; where points are to be hidden one warp, each lane of which tests one
// wall at a time.
#include "spawn.h"
#include "common/warp_cuda.h"

template <int hidden, int with_objects>
DEVICE void spawn_in(const SpawnParams& p) {
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / (hidden ? WARP : 1);
    if (env >= p.scenery.n_envs)
        return;
    if constexpr (hidden)
        spawn_env<1, with_objects>(p, WholeWarp{(int)threadIdx.x % WARP}, env);
    else
        spawn_env<0, with_objects>(p, SingleThread{0}, env);
}

INSTANCE(spawn, SpawnParams, spawn_in<0, 0>)
INSTANCE(spawn_objects, SpawnParams, spawn_in<0, 1>)
INSTANCE(spawn_hidden, SpawnParams, spawn_in<1, 0>)
INSTANCE(spawn_hidden_objects, SpawnParams, spawn_in<1, 1>)
