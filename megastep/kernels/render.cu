// One warp per agent, for many agents and for all outputs: so many warps per multiprocessor that 40
// registers are left for each thread, which spills some.
#include "render_cuda.h"

KERNEL BOUNDS(24) render(RenderParams p) {
    wait_for_previous();
    render_by_warps<1>(p);
}
