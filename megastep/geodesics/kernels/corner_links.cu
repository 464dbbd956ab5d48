// One thread per corner.
#include "shortest_paths.h"

KERNEL corner_links(CornerLinksParams p) {
    wait_for_previous();
    int corner = blockIdx.x * blockDim.x + threadIdx.x;
    if (corner >= p.homes.n_corners)
        return;
    if (p.starts)
        write_links(p, corner, nullptr);
    else
        count_links(p, corner, nullptr);
}
