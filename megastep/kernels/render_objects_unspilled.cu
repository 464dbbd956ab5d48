// Does what render_unspilled.cu does, with objects.
#include "render_cuda.h"

KERNEL BOUNDS(18) render_objects_unspilled(RenderParams p) {
    wait_for_previous();
    render_by_warps<0, 1>(p);
}
