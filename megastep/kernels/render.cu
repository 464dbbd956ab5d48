// One warp per agent.
#include "render_cuda.h"

// Three variants: all outputs, several agents, one agent. The last needs the fewest registers.
KERNEL BOUNDS(24) render(RenderParams p) {
    wait_for_previous();
    extern __shared__ NearestLine shared[];
    __shared__ PixelSpan spans[BLOCK];
    int warp = threadIdx.x / WARP, warp_lane = threadIdx.x % WARP;
    int agent = blockIdx.x * (BLOCK / WARP) + warp;
    if (agent >= p.scenery.n_envs * p.scenery.n_agents)
        return;
    PixelSpan* warp_spans = spans + WARP * warp;
    NearestLine* nearest = shared + whole_tiles(p.res) * warp;
    if (p.indices)
        render_agent<1, 1, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
    else if (p.scenery.n_agents > 1)
        render_agent<0, 1, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
    else
        render_agent<0, 0, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
}
