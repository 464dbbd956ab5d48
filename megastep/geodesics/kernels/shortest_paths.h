// Shortest paths of a disc between walls.
//
// The disc's centre keeps `clearance` metres from every wall. Around the end of each wall lies a
// regular polygon whose sides touch the circle of that radius. A shortest path is a polyline that
// bends only at corners of these polygons, and only around them, as a taut string does: a
// visibility graph (Lozano-Perez and Wesley 1979) of tangents.
//
// Coordinates are relative to the home, so floats are exact to some micrometres.
#pragma once
#include "common/math.h"
#include "params.h"

constexpr float TANGENT_SLACK = 2e-3f;    // radians: the sides of a polygon count as tangents
constexpr float POLYGON_SLACK = 2.5e-3f;  // metres: so do lines from between circle and polygon
constexpr float MIN_SIDE = 0.036f;        // metres, see reachable_point
constexpr float PUSH = 2.2e-3f;           // metres further than needed: beyond the polygon
constexpr int MAX_PUSHES = 12;

struct Point {
    float x, y;
};

HD Point point_at(const float* points, long long i) { return {points[2 * i], points[2 * i + 1]}; }

HD float distance_between(Point p, Point q) {
    float dx = q.x - p.x, dy = q.y - p.y;
    return SQRT(dx * dx + dy * dy);
}

// ---- Walls ----

// The walls of one home, in groups of GROUP with a bounding box each.
struct HomeWalls {
    const float *ax, *ay, *bx, *by;
    const float *low_x, *low_y, *high_x, *high_y;
    int n_groups;
};

HD HomeWalls walls_of(const HomesParams& p, int home) {
    int first = p.group_starts[home];
    const float *walls = p.walls + GROUP * first, *boxes = p.boxes + first;
    long long n = GROUP * (long long)p.n_groups, m = p.n_groups;
    return {walls,         walls + n,     walls + 2 * n,
            walls + 3 * n, boxes,         boxes + m,
            boxes + 2 * m, boxes + 3 * m, p.group_starts[home + 1] - first};
}

// Metres, squared, from wall i to q. The way to q from the nearest point of the wall is (x, y).
HD float squared_distance(const HomeWalls& walls, int i, Point q, float& x, float& y) {
    float vx = walls.bx[i] - walls.ax[i], vy = walls.by[i] - walls.ay[i];
    float dx = q.x - walls.ax[i], dy = q.y - walls.ay[i];
    float along = clamp((dx * vx + dy * vy) / maxf(vx * vx + vy * vy, 1e-12f), 0.f, 1.f);
    x = dx - along * vx;
    y = dy - along * vy;
    return x * x + y * y;
}

struct Bounds {
    float low_x, low_y, high_x, high_y;
};

HD Bounds bounds_of(Point p, Point q, float margin) {
    return {minf(p.x, q.x) - margin, minf(p.y, q.y) - margin, maxf(p.x, q.x) + margin,
            maxf(p.y, q.y) + margin};
}

// Calls visit(group) for each group of walls whose bounding box overlaps `bounds`, until one call
// returns 1. Returns that, or 0.
template <class Visit>
HD int any_group(const HomeWalls& walls, const Bounds& bounds, Visit visit) {
    for (int first = 0; first < walls.n_groups; first += GROUP) {
        unsigned int overlapping = 0;
#pragma omp simd reduction(| : overlapping)
        for (int k = 0; k < GROUP; k++) {
            int overlaps = (walls.low_x[first + k] <= bounds.high_x) &
                           (walls.high_x[first + k] >= bounds.low_x) &
                           (walls.low_y[first + k] <= bounds.high_y) &
                           (walls.high_y[first + k] >= bounds.low_y);
            overlapping |= (unsigned int)overlaps << k;
        }
        int n_left = walls.n_groups - first;
        if (n_left < GROUP)
            overlapping &= (1u << n_left) - 1u;
        for (; overlapping; overlapping &= overlapping - 1u)
            if (visit(first + COUNT_BITS((overlapping & (0u - overlapping)) - 1u)))
                return 1;
    }
    return 0;
}

// Metres, squared, from q to the nearest wall, at most `most`. `group` is that wall's.
HD float squared_clearance(const HomeWalls& walls, Point q, float most, int& group) {
    float nearest = most;
    any_group(walls, bounds_of(q, q, SQRT(most)), [&](int k) {
        float least = INF_VALUE, x, y;
        for (int i = 0; i < GROUP; i++)
            least = minf(least, squared_distance(walls, GROUP * k + i, q, x, y));
        group = least < nearest ? k : group;
        nearest = minf(nearest, least);
        return 0;
    });
    return nearest;
}

// A straight line from p to p + d, that is to keep sqrt(least2) metres from walls.
struct Line {
    Point p;
    float dx, dy, inverse;  // 1 / |d|^2
    float least2;
};

HD Line line_between(Point p, Point q, float least2) {
    float dx = q.x - p.x, dy = q.y - p.y, length2 = dx * dx + dy * dy;
    return {p, dx, dy, length2 > 0.f ? 1.f / length2 : 0.f, least2};
}

// Returns 1 if wall i crosses the line or comes too near to it. The ends of the line are not
// tested: they are clear already.
HD int blocks(const HomeWalls& walls, int i, const Line& line) {
    float dx = line.dx, dy = line.dy;
    float rx = walls.ax[i] - line.p.x, ry = walls.ay[i] - line.p.y;
    float sx = walls.bx[i] - line.p.x, sy = walls.by[i] - line.p.y;
    float t = clamp((rx * dx + ry * dy) * line.inverse, 0.f, 1.f);
    float u = clamp((sx * dx + sy * dy) * line.inverse, 0.f, 1.f);
    float ex = rx - t * dx, ey = ry - t * dy, fx = sx - u * dx, fy = sy - u * dy;
    float wx = sx - rx, wy = sy - ry;
    float side_a = cross(dx, dy, rx, ry), side_b = cross(dx, dy, sx, sy);
    float near_side = cross(wx, wy, rx, ry), far_side = cross(wx, wy, rx - dx, ry - dy);
    return (ex * ex + ey * ey < line.least2) | (fx * fx + fy * fy < line.least2) |
           ((side_a * side_b < 0.f) & (near_side * far_side < 0.f));
}

HD int group_blocks(const HomeWalls& walls, int group, const Line& line) {
    int blocked = 0;
    for (int i = GROUP * group; i < GROUP * group + GROUP; i++)
        blocked |= blocks(walls, i, line);
    return blocked;
}

// Returns 1 if the straight line between two points keeps sqrt(least2) metres from all walls.
HD int is_clear(const HomeWalls& walls, Point p, Point q, float least2) {
    Line line = line_between(p, q, least2);
    return !any_group(walls, bounds_of(p, q, SQRT(least2)),
                      [&](int k) { return group_blocks(walls, k, line); });
}

// ---- Corners ----

// The corners of polygons: of all homes, numbered from the first home's.
struct Corners {
    const float *x, *y, *normal_x, *normal_y, *next_x, *next_y;
};

HD Corners corners_of(const HomesParams& p) {
    const float* rows = p.corners;
    long long n = p.n_corners;
    return {rows, rows + n, rows + 2 * n, rows + 3 * n, rows + 4 * n, rows + 5 * n};
}

HD Point corner_at(const Corners& corners, int corner) {
    return {corners.x[corner], corners.y[corner]};
}

// Returns 1 if the line from `p` to a corner touches its polygon from outside: if `p` is not
// beyond both sides that meet there, nor behind both.
HD int is_tangent(const Corners& corners, int corner, Point p) {
    float dx = p.x - corners.x[corner], dy = p.y - corners.y[corner];
    float a = dx * corners.normal_x[corner] + dy * corners.normal_y[corner];
    float b = dx * corners.next_x[corner] + dy * corners.next_y[corner];
    float slack2 =
        maxf(TANGENT_SLACK * TANGENT_SLACK * (dx * dx + dy * dy), POLYGON_SLACK * POLYGON_SLACK);
    return (a * b <= 0.f) | (a * a <= slack2) | (b * b <= slack2);
}

HD float link_metres(const HomesParams& p, const Corners& corners, int corner, int other) {
    float straight = distance_between(corner_at(corners, corner), corner_at(corners, other));
    return maxf(straight - p.rebate, 0.f);
}

// Calls found(other) for each corner of a home that a shortest path may visit next to `corner`.
template <class Found>
HD void each_link(const HomesParams& p, int home, int corner, Found found) {
    int first = p.corner_starts[home], end = p.corner_starts[home + 1];
    HomeWalls walls = walls_of(p, home);
    Corners corners = corners_of(p);
    Point here = corner_at(corners, corner);
    for (int other = first; other < end; other++) {
        Point there = corner_at(corners, other);
        if (is_tangent(corners, other, here) && other != corner &&
            is_tangent(corners, corner, there) &&
            is_clear(walls, here, there, p.clearance * p.clearance))
            found(other);
    }
}

// Counts a corner's links, and keeps the first KEPT.
HD void count_links(const CornerLinksParams& p, int corner) {
    int n = 0;
    each_link(p.homes, p.corner_homes[corner], corner, [&](int other) {
        if (n < KEPT)
            p.kept[(long long)KEPT * corner + n] = other;
        n++;
    });
    p.counts[corner] = n;
}

// Writes a corner's links behind those of the corners before.
HD void write_links(const CornerLinksParams& p, int corner) {
    Corners corners = corners_of(p.homes);
    int next = p.starts[corner], n = p.starts[corner + 1] - next;
    auto write = [&](int other) {
        p.targets[next] = other;
        p.metres[next++] = link_metres(p.homes, corners, corner, other);
    };
    if (n > KEPT)
        each_link(p.homes, p.corner_homes[corner], corner, write);
    else
        for (int k = 0; k < n; k++)
            write(p.kept[(long long)KEPT * corner + k]);
}

// The distance of a corner from a goal in a straight line, infinite if that is no path.
HD float straight_to_goal(const CornerDistancesParams& p, int home, int corner, int goal) {
    Corners corners = corners_of(p.homes);
    Point start = corner_at(corners, corner);
    Point end = point_at(p.goals, (long long)home * p.n_goals + goal);
    float least2 = p.homes.clearance * p.homes.clearance;
    if (!is_tangent(corners, corner, end) || !is_clear(walls_of(p.homes, home), start, end, least2))
        return INF_VALUE;
    return maxf(distance_between(start, end) - p.homes.rebate, 0.f);
}

// ---- Points ----

HD int home_of(const PathLengthsParams& p, int i) {
    int low = 0, high = p.homes.n_homes;
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (p.point_starts[middle] <= i)
            low = middle;
        else
            high = middle;
    }
    return low;
}

// Point i, of a home: one that is given, or the centre of a cell, row by row.
HD Point nth_point(const PathLengthsParams& p, int home, int i) {
    if (p.points)
        return point_at(p.points, i);
    int number = i - p.point_starts[home], row = number / p.widths[home];
    return {p.cell * (float)(number - row * p.widths[home]), p.cell * (float)row};
}

// Moves a point that is too close to walls away from them, to where a disc fits. Returns 0 if there
// is no such place nearby.
//
// Fields are interpolated between cells 0.1 m apart, some of them too close to walls for an agent.
// An agent on the other side of a wall never reads a cell more than MIN_SIDE from it: it keeps a
// radius (0.106 m) away, and cells are at most 0.141 m apart.
HD int reachable_point(const HomesParams& p, const HomeWalls& walls, Point& q) {
    Point from = q;
    int group = 0;
    float least2 = p.clearance * p.clearance;
    float nearest = squared_clearance(walls, q, least2, group);
    if (nearest < MIN_SIDE * MIN_SIDE)
        return 0;
    for (int push = 0; push < MAX_PUSHES && nearest < least2; push++) {
        float x = 0.f, y = 0.f;
        for (int i = GROUP * group; i < GROUP * group + GROUP; i++)
            if (squared_distance(walls, i, q, x, y) == nearest)
                break;
        float distance = SQRT(nearest);
        float step = (p.clearance + PUSH - distance) / maxf(distance, 1e-6f);
        q.x += step * x;
        q.y += step * y;
        nearest = squared_clearance(walls, q, least2, group);
    }
    return nearest >= least2 && is_clear(walls, from, q, 0.f);
}

// The shortest paths from a point to the goals of its home, as far as they are known.
struct Paths {
    Point at, from;             // the point, and the nearest one where a disc fits
    float shortest[MAX_GOALS];  // metres from there
    float length[MAX_GOALS];    // metres to the point itself: extrapolated
    int corner[MAX_GOALS];      // the first corner, -1: straight to the goal
};

// Goes from the point to all goals by way of a corner to which its line is a tangent, where that is
// shorter. Of equal paths, the one by the corner with the lower number is kept, so that the outcome
// does not depend on the order of trials.
HD void try_corner(const PathLengthsParams& p, const HomeWalls& walls, int corner, Paths& paths) {
    Point bend = corner_at(corners_of(p.homes), corner);
    const float* distances = p.distances + (long long)MAX_GOALS * corner;
    float straight = distance_between(paths.from, bend);
    int improves = 0;
#pragma omp simd reduction(| : improves)
    for (int goal = 0; goal < MAX_GOALS; goal++) {
        float metres = straight + distances[goal];
        improves |= (metres < paths.shortest[goal]) |
                    ((metres == paths.shortest[goal]) & (corner < paths.corner[goal]));
    }
    if (!improves || !is_clear(walls, paths.from, bend, p.homes.clearance * p.homes.clearance))
        return;
    float extrapolated = distance_between(paths.at, bend);
#pragma omp simd
    for (int goal = 0; goal < MAX_GOALS; goal++) {
        float metres = straight + distances[goal];
        int better = (metres < paths.shortest[goal]) |
                     ((metres == paths.shortest[goal]) & (corner < paths.corner[goal]));
        paths.shortest[goal] = better ? metres : paths.shortest[goal];
        paths.length[goal] = better ? extrapolated + distances[goal] : paths.length[goal];
        paths.corner[goal] = better ? corner : paths.corner[goal];
    }
}

// Writes the lengths of the shortest paths from point i to the goals of its home.
HD void point_lengths(const PathLengthsParams& p, int i) {
    int home = home_of(p, i), end = p.homes.corner_starts[home + 1];
    HomeWalls walls = walls_of(p.homes, home);
    Corners corners = corners_of(p.homes);
    float least2 = p.homes.clearance * p.homes.clearance;
    Paths paths;
    paths.at = paths.from = nth_point(p, home, i);
    int fits = reachable_point(p.homes, walls, paths.from);
    for (int goal = 0; goal < MAX_GOALS; goal++) {
        paths.shortest[goal] = paths.length[goal] = INF_VALUE;
        paths.corner[goal] = -1;
        if (!fits || goal >= p.n_goals)
            continue;
        Point at = point_at(p.goals, (long long)home * p.n_goals + goal);
        if (is_clear(walls, paths.from, at, least2)) {
            paths.shortest[goal] = distance_between(paths.from, at);
            paths.length[goal] = distance_between(paths.at, at);
        }
    }
    for (int corner = p.homes.corner_starts[home]; fits && corner < end; corner++)
        if (is_tangent(corners, corner, paths.from))
            try_corner(p, walls, corner, paths);
    int first = p.point_starts[home], n_points = p.point_starts[home + 1] - first;
    float* lengths = p.lengths + (long long)first * p.n_goals + (i - first);
    for (int goal = 0; goal < MAX_GOALS; goal++)
        if (goal < p.n_goals)
            lengths[(long long)goal * n_points] = paths.length[goal];
}

// Metres from point i to the nearest wall, at most `most`.
HD float nearest_wall(const ClearancesParams& p, int i) {
    int group = 0;
    HomeWalls walls = walls_of(p.homes, p.home_index[i]);
    return SQRT(squared_clearance(walls, point_at(p.points, i), p.most * p.most, group));
}
