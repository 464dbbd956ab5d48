// One thread per point.
#include "shortest_paths.h"

KERNEL path_lengths(PathLengthsParams p) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= p.n_points)
        return;
    int home = home_of(p, i);
    HomeWalls walls = walls_of(p.homes, home);
    Corners corners = corners_of(p.homes);
    Paths paths;
    paths.at = paths.from = nth_point(p, home, i);
    int fits = reachable_point(p.homes, walls, paths.from);
    if (fits) {
        clear_paths(paths);
        for (int goal = 0; goal < MAX_GOALS; goal++)
            if (goal < p.n_goals)
                try_straight(p, home, walls, goal, paths, nullptr);
        int end = p.homes.corner_starts[home + 1];
        for (int corner = p.homes.corner_starts[home]; corner < end; corner++)
            if (is_tangent(corners, corner, paths.from))
                try_corner(p, walls, corner, paths, nullptr);
    }
    write_lengths(p, home, i, paths, fits);
}
