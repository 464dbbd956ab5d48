// The order of random keys: a warp counts the keys before its own. Up to some thousand keys that
// takes less time than a sort, which is several dependent kernels.
#include "common/constants.h"
#include "common/dependent_launch.h"
#include "params.h"

KERNEL order(OrderParams p) {
    wait_for_previous();
    int at = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, n_before = 0;
    if (at >= p.n)
        return;
    float key = p.keys[at];
#pragma unroll 8
    for (int i = threadIdx.x % WARP; i < p.n; i += WARP) {
        float other = p.keys[i];
        n_before += other < key || (other == key && i < at);
    }
    n_before = __reduce_add_sync(~0u, n_before);
    if (threadIdx.x % WARP == 0)
        p.order[n_before] = at;
}
