// Does what render.cu does, with objects.
#include "render_cuda.h"

KERNEL BOUNDS(24) render_objects(RenderParams p) {
    wait_for_previous();
    render_by_warps<1, 1>(p);
}
