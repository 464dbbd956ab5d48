// One thread per point.
#include "shortest_paths.h"

KERNEL path_lengths(PathLengthsParams p) {
    wait_for_previous();
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= p.n_points)
        return;
    int home = home_of(p, i);
    HomeWalls walls = walls_of(p.homes, home);
    Corners corners = corners_of(p.homes);
    float least2 = p.homes.clearance * p.homes.clearance;
    auto clear = [&](Point from, Point to) { return is_clear(walls, from, to, least2, nullptr); };
    Paths paths;
    paths.at = paths.from = nth_point(p, home, i);
    int fits = reachable_point(p.homes, walls, paths.from);
    if (fits) {
        clear_paths(paths);
        for (int goal = 0; goal < MAX_GOALS; goal++)
            if (goal < p.n_goals)
                try_straight(p, home, goal, paths, clear);
        int end = p.homes.corner_starts[home + 1];
        for (int corner = p.homes.corner_starts[home]; corner < end; corner++)
            if (is_tangent(corners, corner, paths.from))
                try_corner(p, corner, paths, clear);
    }
    write_lengths(p, home, i, paths, fits);
}
