// A loop over homes.
#include "shortest_paths.h"

KERNEL corner_links(const CornerLinksParams& p) {
    const HomesParams& homes = p.homes;
    Corners corners = corners_of(homes);
#pragma omp parallel for schedule(dynamic, 1) num_threads(homes.n_threads)
    for (int home = 0; home < homes.n_homes; home++) {
        int first = homes.corner_starts[home], end = homes.corner_starts[home + 1];
        int* tangent = p.tangent + first;
        for (int corner = first; corner < end; corner++) {
            if (p.starts) {
                write_links(p, corner, nullptr);
                continue;
            }
            Point here = corner_at(corners, corner);
#pragma omp simd
            for (int other = first; other < end; other++)
                tangent[other - first] = is_tangent(corners, other, here);
            count_links(p, corner, tangent);
        }
    }
}
