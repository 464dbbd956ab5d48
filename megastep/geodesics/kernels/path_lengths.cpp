// A loop over homes, and in each over points. The wall that hid a corner from a point is the first
// that is tested for the next point.
#include "shortest_paths.h"

static void home_lengths(const PathLengthsParams& p, int home) {
    HomeWalls walls = walls_of(p.homes, home);
    Corners corners = corners_of(p.homes);
    float least2 = p.homes.clearance * p.homes.clearance;
    int first = p.homes.corner_starts[home], end = p.homes.corner_starts[home + 1];
    int *hints = p.hints, goal_hints[MAX_GOALS];
    for (int corner = first; corner < end; corner++)
        hints[corner] = -1;
    for (int goal = 0; goal < MAX_GOALS; goal++)
        goal_hints[goal] = -1;
    for (int i = p.point_starts[home]; i < p.point_starts[home + 1]; i++) {
        Paths paths;
        paths.at = paths.from = nth_point(p, home, i);
        int fits = reachable_point(p.homes, walls, paths.from), *hint;
        auto clear = [&](Point from, Point to) { return is_clear(walls, from, to, least2, hint); };
        if (fits) {
            clear_paths(paths);
            for (int goal = 0; goal < p.n_goals; goal++) {
                hint = goal_hints + goal;
                try_straight(p, home, goal, paths, clear);
            }
            for (int corner = first; corner < end; corner++)
                if (is_tangent(corners, corner, paths.from)) {
                    hint = hints + corner;
                    try_corner(p, corner, paths, clear);
                }
        }
        write_lengths(p, home, i, paths, fits);
    }
}

KERNEL path_lengths(const PathLengthsParams& p) {
#pragma omp parallel for schedule(dynamic, 1) num_threads(p.homes.n_threads)
    for (int home = 0; home < p.homes.n_homes; home++)
        home_lengths(p, home);
}
