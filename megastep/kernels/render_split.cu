// Does what render.cu does, with a block of two warps per agent, for few agents. It takes whole
// tiles of 32 rays, so `subsample` must divide 32.
#include "render_cuda.h"

static_assert(BLOCK == 2 * WARP, "each of two warps has half_of_screen");

KERNEL BOUNDS(18) render_split(RenderParams p) {
    wait_for_previous();
    extern __shared__ NearestLine nearest[];
    __shared__ PixelSpan spans[BLOCK];
    __shared__ int newly_seen_by_warp[BLOCK / WARP];
    int warp_lane = threadIdx.x % WARP;
    PixelSpan* warp_spans = spans + (threadIdx.x - warp_lane);
    if (p.scenery.n_agents > 1)
        render_agent<0, 1, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest, newly_seen_by_warp);
    else
        render_agent<0, 0, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest, newly_seen_by_warp);
}
