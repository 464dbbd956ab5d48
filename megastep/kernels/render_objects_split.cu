// Does what render_split.cu does, with objects.
#include "render_cuda.h"

KERNEL BOUNDS(18) render_objects_split(RenderParams p) {
    wait_for_previous();
    extern __shared__ NearestLine nearest[];
    __shared__ PixelSpan spans[BLOCK];
    __shared__ int newly_seen_by_warp[BLOCK / WARP];
    int warp_lane = threadIdx.x % WARP;
    PixelSpan* warp_spans = spans + (threadIdx.x - warp_lane);
    if (p.scenery.n_agents > 1)
        render_agent<0, AGENTS | OBJECTS, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                             newly_seen_by_warp);
    else
        render_agent<0, OBJECTS, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                    newly_seen_by_warp);
}
