// `render` is for many agents and for all outputs: one warp per agent, and so many warps per
// multiprocessor that 40 registers are left for each thread, which spills some. `unspilled`, for
// observations only, has fewer, with 56 registers per thread: faster until there are many agents.
// `split`, for few agents, has a block of two warps per agent. It takes whole tiles of 32 rays, so
// `subsample` must divide 32.
#include "render_cuda.h"

static_assert(BLOCK == 2 * WARP, "each of two warps has half_of_screen");

template <int with_objects>
DEVICE void render_halves(const RenderParams& p) {
    extern __shared__ NearestLine nearest[];
    __shared__ PixelSpan spans[BLOCK];
    __shared__ int newly_seen_by_warp[BLOCK / WARP];
    int warp_lane = threadIdx.x % WARP;
    PixelSpan* warp_spans = spans + (threadIdx.x - warp_lane);
    if (p.scenery.n_agents > 1)
        render_agent<0, AGENTS | with_objects, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                                  newly_seen_by_warp);
    else
        render_agent<0, with_objects, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                         newly_seen_by_warp);
}

INSTANCE(BOUNDS(24) render, RenderParams, render_by_warps<1>)
INSTANCE(BOUNDS(24) render_objects, RenderParams, render_by_warps<1, 1>)
INSTANCE(BOUNDS(18) render_unspilled, RenderParams, render_by_warps<0>)
INSTANCE(BOUNDS(18) render_objects_unspilled, RenderParams, render_by_warps<0, 1>)
INSTANCE(BOUNDS(18) render_split, RenderParams, render_halves<0>)
INSTANCE(BOUNDS(18) render_objects_split, RenderParams, render_halves<OBJECTS>)
