// One thread per corner.
#include "shortest_paths.h"

KERNEL corner_links(CornerLinksParams p) {
    int corner = blockIdx.x * blockDim.x + threadIdx.x;
    if (corner < p.homes.n_corners)
        link_corner(p, corner, nullptr);
}
