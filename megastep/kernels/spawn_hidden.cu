// One warp per environment: each warp lane tests one wall at a time.
#include "spawn.h"

struct WholeWarp {
    static constexpr int SIZE = WARP;
    int rank;
};

DEVICE void sync(const WholeWarp&) { __syncwarp(); }

DEVICE unsigned int reduce_or(const WholeWarp&, unsigned int bits) {
    return __reduce_or_sync(FULL_WARP, bits);
}

KERNEL spawn_hidden(SpawnParams p) {
    wait_for_previous();
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (env < p.scenery.n_envs)
        spawn_env<1>(p, WholeWarp{(int)threadIdx.x % WARP}, env);
}
