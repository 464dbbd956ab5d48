// A loop over homes, and in each over groups of neighbouring points. Their paths have much in
// common: corners that none of them sees are left out for all, the corners that the last point's
// paths took are tried first, and of each line the walls that blocked it last.
#include "neighbours.h"

// Copies of those corners of a home that matter to a group of points, in the scratch memory.
struct Nearby {
    float* rows[6];
    int *index, *tangent;
    int n;
    int goals[MAX_GOALS], n_goals;
};

static void find_nearby(const PathLengthsParams& p, int home, const HomeWalls& walls,
                        const Box& box, int* hints, int* goal_hints, Nearby& nearby) {
    Corners corners = corners_of(p.homes);
    int first = p.homes.corner_starts[home], end = p.homes.corner_starts[home + 1];
    float least2 = p.homes.clearance * p.homes.clearance;
    int* off = nearby.tangent;  // no longer needed by the group before
    int is_small = maxf(box.at[3].x - box.at[0].x, box.at[3].y - box.at[0].y) < MAX_BOX;
#pragma omp simd
    for (int corner = first; corner < end; corner++)
        off[corner - first] = is_off_tangents(corners, corner, box);
    nearby.n = 0;
    for (int corner = first; corner < end; corner++) {
        if (off[corner - first] ||
            (is_small && is_hidden(walls, corner_at(corners, corner), box, least2, hints[corner])))
            continue;
        for (int row = 0; row < 6; row++)
            nearby.rows[row][nearby.n] = corners.x[(long long)row * p.homes.n_corners + corner];
        nearby.index[nearby.n++] = corner;
    }
    nearby.n_goals = 0;
    for (int goal = 0; goal < p.n_goals; goal++)
        if (!is_small || !is_hidden(walls, point_at(p.goals, (long long)home * p.n_goals + goal),
                                    box, least2, goal_hints[goal]))
            nearby.goals[nearby.n_goals++] = goal;
}

static void find_tangents(const Nearby& nearby, Point q) {
    float* const* r = nearby.rows;
    Corners corners = {r[0], r[1], r[2], r[3], r[4], r[5]};
    int* tangent = nearby.tangent;
    int n = nearby.n;
#pragma omp simd
    for (int i = 0; i < n; i++)
        tangent[i] = is_tangent(corners, i, q);
}

static void home_lengths(const PathLengthsParams& p, int home) {
    const HomesParams& homes = p.homes;
    HomeWalls walls = walls_of(homes, home);
    int first_corner = homes.corner_starts[home], end_corner = homes.corner_starts[home + 1];
    long long n = homes.n_corners;
    int *hints = p.scratch, *box_hints = p.scratch + n;
    for (int corner = first_corner; corner < end_corner; corner++)
        hints[corner] = box_hints[corner] = -1;
    int goal_hints[MAX_GOALS], box_goal_hints[MAX_GOALS], last[MAX_GOALS];
    for (int goal = 0; goal < MAX_GOALS; goal++)
        goal_hints[goal] = box_goal_hints[goal] = last[goal] = -1;
    Nearby nearby;
    int* scratch = p.scratch + first_corner;
    for (int row = 0; row < 6; row++)
        nearby.rows[row] = (float*)(scratch + (2 + row) * n);
    nearby.index = scratch + 8 * n;
    nearby.tangent = scratch + 9 * n;

    int end = p.point_starts[home + 1];
    for (int first = p.point_starts[home]; first < end; first += N_NEIGHBOURS) {
        int fits[N_NEIGHBOURS], n_points = mini(N_NEIGHBOURS, end - first), n_fitting = 0;
        Point from[N_NEIGHBOURS], fitting[N_NEIGHBOURS];
        for (int k = 0; k < n_points; k++) {
            from[k] = point_at(p.points, p.order[first + k]);
            fits[k] = reachable_point(homes, walls, from[k]);
            if (fits[k])
                fitting[n_fitting++] = from[k];
        }
        if (n_fitting)
            find_nearby(p, home, walls, box_around(fitting, n_fitting), box_hints, box_goal_hints,
                        nearby);
        for (int k = 0; k < n_points; k++) {
            int i = p.order[first + k];
            Paths paths;
            paths.at = point_at(p.points, i);
            paths.from = from[k];
            if (fits[k]) {
                clear_paths(paths);
                for (int j = 0; j < nearby.n_goals; j++)
                    try_straight(p, home, walls, nearby.goals[j], paths,
                                 goal_hints + nearby.goals[j]);
                Corners corners = corners_of(homes);
                for (int goal = 0; goal < p.n_goals; goal++)
                    if (last[goal] >= 0 && (!goal || last[goal] != last[goal - 1]) &&
                        is_tangent(corners, last[goal], paths.from))
                        try_corner(p, walls, last[goal], paths, hints + last[goal]);
                find_tangents(nearby, paths.from);
                for (int j = 0; j < nearby.n; j++)
                    if (nearby.tangent[j])
                        try_corner(p, walls, nearby.index[j], paths, hints + nearby.index[j]);
                for (int goal = 0; goal < MAX_GOALS; goal++)
                    last[goal] = paths.corner[goal];
            }
            write_lengths(p, home, i, paths, fits[k]);
        }
    }
}

KERNEL path_lengths(const PathLengthsParams& p) {
#pragma omp parallel for schedule(dynamic, 1) num_threads(p.homes.n_threads)
    for (int home = 0; home < p.homes.n_homes; home++)
        home_lengths(p, home);
}
