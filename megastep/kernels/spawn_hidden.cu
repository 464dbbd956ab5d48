// One warp per environment, whose warp lanes look at a wall each.
#include "spawn.h"

struct Warp {
    static constexpr int SIZE = WARP;
    int rank;
};

DEVICE void sync(const Warp&) { __syncwarp(); }

DEVICE unsigned int unite(const Warp&, unsigned int bits) {
    return __reduce_or_sync(FULL_WARP, bits);
}

KERNEL spawn_hidden(SpawnParams p) {
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (env < p.scenery.n_envs)
        spawn_env<1>(p, Warp{(int)threadIdx.x % WARP}, env);
}
