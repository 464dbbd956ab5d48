// One warp per agent, as render.cu, but fewer per multiprocessor, with 56 registers each: faster
// until there are many agents.
#include "render_cuda.h"

KERNEL BOUNDS(18) render_unspilled(RenderParams p) {
    wait_for_previous();
    render_by_warps<0>(p);
}
