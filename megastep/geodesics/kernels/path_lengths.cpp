// A loop over homes, and in each over groups of neighbouring points. Their paths have much in
// common: corners and goals that none of them sees are left out for all, the corners that the last
// point's paths took are tried first, and of each line the walls that blocked it last.
#include "neighbours.h"

// The search in one home. Arrays begin with the home's first corner.
struct Search {
    const PathLengthsParams& p;
    int home, first, n_corners;
    HomeWalls walls;
    Corners corners;
    float least2;
    int *hints, *box_hints;  // per corner: the walls that hid the last point and the last group
    int* leads;              // per corner: 1 if some goal can be reached from there
    int goal_hints[MAX_GOALS], box_goal_hints[MAX_GOALS];
    int last[MAX_GOALS];  // the corners that the last point's paths took
    // of the corners that matter to a group of points: copies, the walls of their hints, numbers
    float *rows[6], *hint_walls[4];
    int *nearby, n_nearby, *is_open;
    int goals[MAX_GOALS], n_goals;
    // per corner: 1 if it matters to the group of points, and the walls between them, see Groups
    int *is_near, *low_groups, *high_groups;
    Groups goal_groups[MAX_GOALS];

    Search(const PathLengthsParams& p, int home)
        : p(p),
          home(home),
          first(p.homes.corner_starts[home]),
          n_corners(p.homes.corner_starts[home + 1] - first),
          walls(walls_of(p.homes, home)),
          corners(corners_of(p.homes)),
          least2(p.homes.clearance * p.homes.clearance) {
        int* scratch[N_SCRATCH];
        for (int row = 0; row < N_SCRATCH; row++)
            scratch[row] = p.scratch + first + (long long)row * p.homes.n_corners;
        hints = scratch[0];
        box_hints = scratch[1];
        leads = scratch[2];
        nearby = scratch[3];
        is_open = scratch[4];
        for (int row = 0; row < 6; row++)
            rows[row] = (float*)scratch[5 + row];
        for (int row = 0; row < 4; row++)
            hint_walls[row] = (float*)scratch[11 + row];
        is_near = scratch[15];
        low_groups = scratch[16];
        high_groups = scratch[17];
        for (int i = 0; i < n_corners; i++) {
            hints[i] = box_hints[i] = -1;
            leads[i] = 0;
            for (int goal = 0; goal < p.n_goals; goal++)
                leads[i] |= is_finite(p.distances[(long long)MAX_GOALS * (first + i) + goal]);
        }
        for (int goal = 0; goal < MAX_GOALS; goal++)
            goal_hints[goal] = box_goal_hints[goal] = last[goal] = -1;
    }

    // Copies the wall that hid corner nearby[i]; if none did, one that is far away.
    void copy_hint(int i) {
        int hint = hints[nearby[i] - first];
        const float* from[4] = {walls.ax, walls.ay, walls.bx, walls.by};
        for (int row = 0; row < 4; row++)
            hint_walls[row][i] = hint < 0 ? 1e9f : from[row][hint];
    }

    // Finds the corners and goals that some point in the box may see.
    void find_nearby(const Box& box) {
        float margin = 1.001f * p.homes.clearance;  // more than rounding takes away
        int is_small = maxf(box.at[3].x - box.at[0].x, box.at[3].y - box.at[0].y) < MAX_BOX;
        int* off = is_open;  // no longer needed by the group before
#pragma omp simd
        for (int i = 0; i < n_corners; i++)
            off[i] = is_off_tangents(corners, first + i, box) | !leads[i];
        n_nearby = n_goals = 0;
        for (int i = 0; i < n_corners; i++) {
            is_near[i] = 0;
            if (off[i] || (is_small && is_hidden(walls, corner_at(corners, first + i), box, least2,
                                                 box_hints[i])))
                continue;
            for (int row = 0; row < 6; row++)
                rows[row][n_nearby] = corners.x[(long long)row * p.homes.n_corners + first + i];
            Groups groups = groups_between(walls, corner_at(corners, first + i), box, margin);
            low_groups[i] = (int)groups;
            high_groups[i] = (int)(groups >> 32);
            is_near[i] = 1;
            nearby[n_nearby] = first + i;
            copy_hint(n_nearby++);
        }
        for (int goal = 0; goal < p.n_goals; goal++)
            if (!is_small ||
                !is_hidden(walls, goal_at(p, home, goal), box, least2, box_goal_hints[goal])) {
                goal_groups[goal] = groups_between(walls, goal_at(p, home, goal), box, margin);
                goals[n_goals++] = goal;
            }
    }

    void try_hinted(int corner, Paths& paths) {
        int i = corner - first;
        Groups groups = (Groups)(unsigned)high_groups[i] << 32 | (unsigned)low_groups[i];
        try_corner(p, corner, paths, [&](Point from, Point to) {
            return is_clear_of(walls, groups, from, to, least2, hints + i);
        });
    }

    void try_goal(int goal, Paths& paths) {
        try_straight(p, home, goal, paths, [&](Point from, Point to) {
            return is_clear_of(walls, goal_groups[goal], from, to, least2, goal_hints + goal);
        });
    }

    void find_paths(Paths& paths) {
        clear_paths(paths);
        for (int i = 0; i < n_goals; i++)
            try_goal(goals[i], paths);
        for (int goal = 0; goal < p.n_goals; goal++)
            if (last[goal] >= 0 && is_near[last[goal] - first] &&
                (!goal || last[goal] != last[goal - 1]) &&
                is_tangent(corners, last[goal], paths.from))
                try_hinted(last[goal], paths);
        Corners copies = {rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]};
        const float *ax = hint_walls[0], *ay = hint_walls[1], *bx = hint_walls[2],
                    *by = hint_walls[3];
        Point from = paths.from;
        int n = n_nearby, *open = is_open;
        float least = least2;
#pragma omp simd
        for (int i = 0; i < n; i++) {
            Line line = line_between(from, corner_at(copies, i), least);
            open[i] = is_tangent(copies, i, from) & !wall_blocks(ax[i], ay[i], bx[i], by[i], line);
        }
        for (int i = 0; i < n; i++) {
            if (!open[i])
                continue;
            int hint = hints[nearby[i] - first];
            try_hinted(nearby[i], paths);
            if (hints[nearby[i] - first] != hint)
                copy_hint(i);
        }
        for (int goal = 0; goal < MAX_GOALS; goal++)
            last[goal] = paths.corner[goal];
    }

    // Writes the lengths of n points.
    void group_lengths(const int* points, int n) {
        int fits[ROWS * COLUMNS], n_fitting = 0;
        Point from[ROWS * COLUMNS], fitting[ROWS * COLUMNS];
        for (int k = 0; k < n; k++) {
            from[k] = nth_point(p, home, points[k]);
            fits[k] = reachable_point(p.homes, walls, from[k]);
            if (fits[k])
                fitting[n_fitting++] = from[k];
        }
        if (n_fitting)
            find_nearby(box_around(fitting, n_fitting));
        for (int k = 0; k < n; k++) {
            Paths paths;
            paths.at = nth_point(p, home, points[k]);
            paths.from = from[k];
            if (fits[k])
                find_paths(paths);
            write_lengths(p, home, points[k], paths, fits[k]);
        }
    }
};

static void home_lengths(const PathLengthsParams& p, int home) {
    Search search(p, home);
    // rectangles of cells; of points that form no grid, as many in a row
    int first = p.point_starts[home], n = p.point_starts[home + 1] - first;
    int width = p.points ? n : p.widths[home];
    int rows = p.points ? 1 : ROWS, columns = ROWS * COLUMNS / rows;
    for (int row = 0; row * width < n; row += rows)
        for (int column = 0; column < width; column += columns) {
            int points[ROWS * COLUMNS], n_points = 0;
            for (int r = row; r < row + rows && r * width < n; r++)
                for (int c = column; c < mini(column + columns, width); c++)
                    points[n_points++] = first + r * width + c;
            search.group_lengths(points, n_points);
        }
}

KERNEL path_lengths(const PathLengthsParams& p) {
#pragma omp parallel for schedule(dynamic, 1) num_threads(p.homes.n_threads)
    for (int home = 0; home < p.homes.n_homes; home++)
        home_lengths(p, home);
}
