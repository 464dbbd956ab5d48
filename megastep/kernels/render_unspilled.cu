// One warp per agent, for observations only. Fewer warps per multiprocessor than render.cu, with 56
// registers per thread: faster until there are many agents.
#include "render_cuda.h"

KERNEL BOUNDS(18) render_unspilled(RenderParams p) {
    wait_for_previous();
    render_by_warps<0>(p);
}
