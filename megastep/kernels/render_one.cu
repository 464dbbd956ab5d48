// Does what render.cu does, for environments of one agent, with so few registers that a
// multiprocessor renders 64 of them at once.
#include "render_cuda.h"

KERNEL BOUNDS(32) render_one(RenderParams p) {
    wait_for_previous();
    extern __shared__ NearestLine shared[];
    __shared__ PixelSpan spans[BLOCK];
    int warp = threadIdx.x / WARP, warp_lane = threadIdx.x % WARP;
    int agent = blockIdx.x * (BLOCK / WARP) + warp;
    if (agent < p.scenery.n_envs)
        render_agent<0, 0, 0>(p, agent, warp_lane, spans + WARP * warp,
                              shared + whole_tiles(p.res) * warp, 0);
}
