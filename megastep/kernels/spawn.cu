// One thread per environment; where points are to be hidden one warp, each lane of which tests one
// wall at a time.
#include "spawn.h"
#include "whole_warp.h"

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

KERNEL spawn(SpawnParams p) {
    wait_for_previous();
    spawn_in<0, 0>(p);
}

KERNEL spawn_objects(SpawnParams p) {
    wait_for_previous();
    spawn_in<0, 1>(p);
}

KERNEL spawn_hidden(SpawnParams p) {
    wait_for_previous();
    spawn_in<1, 0>(p);
}

KERNEL spawn_hidden_objects(SpawnParams p) {
    wait_for_previous();
    spawn_in<1, 1>(p);
}
