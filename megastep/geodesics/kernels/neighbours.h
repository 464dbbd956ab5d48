// A search for the corners that matter to a group of neighbouring points, on the CPU.
#pragma once
#include "shortest_paths.h"

constexpr int ROWS = 8, COLUMNS = 8;  // of cells in a group
constexpr float MAX_BOX = 1.5f;       // metres: it does not pay to look for walls that hide more

// A rectangle, as four points.
struct Box {
    Point at[4];
};

HD Box box_around(const Point* points, int n) {
    float low_x = INF_VALUE, low_y = INF_VALUE, high_x = -INF_VALUE, high_y = -INF_VALUE;
    for (int i = 0; i < n; i++) {
        low_x = minf(low_x, points[i].x);
        low_y = minf(low_y, points[i].y);
        high_x = maxf(high_x, points[i].x);
        high_y = maxf(high_y, points[i].y);
    }
    return {{{low_x, low_y}, {low_x, high_y}, {high_x, low_y}, {high_x, high_y}}};
}

// Returns 1 if wall i blocks the lines from p to all corners of a box. It then blocks the line to
// every point in the box, because the shadow of a convex body is convex.
HD int hides(const HomeWalls& walls, int i, const Line* to_corners) {
    return blocks(walls, i, to_corners[0]) & blocks(walls, i, to_corners[1]) &
           blocks(walls, i, to_corners[2]) & blocks(walls, i, to_corners[3]);
}

// Returns 1 if one wall hides a whole box from p. `hint` holds the wall that did so for a box
// nearby. Such a wall also blocks the line to the middle of the box.
HD int is_hidden(const HomeWalls& walls, Point p, const Box& box, float least2, int& hint) {
    Line to_corners[4];
    for (int k = 0; k < 4; k++)
        to_corners[k] = line_between(p, box.at[k], least2);
    if (hint >= 0 && hides(walls, hint, to_corners))
        return 1;
    Point middle = {0.5f * (box.at[0].x + box.at[3].x), 0.5f * (box.at[0].y + box.at[3].y)};
    Line line = line_between(p, middle, least2);
    return any_group(walls, bounds_of(p, middle, SQRT(least2)), [&](int k) {
        if (!group_blocks(walls, k, line))
            return 0;
        int hidden = 0;
        for (int i = GROUP * k; i < GROUP * k + GROUP; i++)
            hidden |= hides(walls, i, to_corners);
        for (int i = GROUP * k; hidden && i < GROUP * k + GROUP; i++)
            hint = hides(walls, i, to_corners) ? i : hint;
        return hidden;
    });
}

// Returns 1 if no line from the box to a corner is a tangent of its polygon: if the box lies beyond
// both sides that meet there, or behind both.
HD int is_off_tangents(const Corners& corners, int corner, const Box& box) {
    int beyond = 1, behind = 1;
    for (int k = 0; k < 4; k++) {
        float dx = box.at[k].x - corners.x[corner], dy = box.at[k].y - corners.y[corner];
        float a = dx * corners.normal_x[corner] + dy * corners.normal_y[corner];
        float b = dx * corners.next_x[corner] + dy * corners.next_y[corner];
        float slack = maxf(TANGENT_SLACK * (maxf(dx, -dx) + maxf(dy, -dy)), POLYGON_SLACK);
        beyond &= (a > slack) & (b > slack);
        behind &= (a < -slack) & (b < -slack);
    }
    return beyond | behind;
}

// The groups of walls that may block a line from p into a box, a bit each: those whose bounding
// boxes lie in a strip around the lines. None if there are more than MAX_MASKED groups.
typedef unsigned long long Groups;
constexpr int MAX_MASKED = 64;

HD Groups groups_between(const HomeWalls& walls, Point p, const Box& box, float margin) {
    if (walls.n_groups > MAX_MASKED)
        return 0;
    Point middle = {0.5f * (box.at[0].x + box.at[3].x), 0.5f * (box.at[0].y + box.at[3].y)};
    float length = maxf(distance_between(p, middle), 1e-6f);
    float ux = (middle.x - p.x) / length, uy = (middle.y - p.y) / length;  // along the strip
    float first = 0.f, last = 0.f, width = 0.f;
    for (int k = 0; k < 4; k++) {
        float dx = box.at[k].x - p.x, dy = box.at[k].y - p.y;
        float along = dx * ux + dy * uy, across = dy * ux - dx * uy;
        first = minf(first, along);
        last = maxf(last, along);
        width = maxf(width, maxf(across, -across));
    }
    float abs_ux = maxf(ux, -ux), abs_uy = maxf(uy, -uy);
    Groups groups = 0;
#pragma omp simd reduction(| : groups)
    for (int k = 0; k < walls.n_groups; k++) {
        float half_x = 0.5f * (walls.high_x[k] - walls.low_x[k]);
        float half_y = 0.5f * (walls.high_y[k] - walls.low_y[k]);
        float dx = walls.low_x[k] + half_x - p.x, dy = walls.low_y[k] + half_y - p.y;
        float along = dx * ux + dy * uy, across = dy * ux - dx * uy;
        float reach_along = half_x * abs_ux + half_y * abs_uy + margin;
        float reach_across = half_x * abs_uy + half_y * abs_ux + margin + width;
        int meets = (along + reach_along >= first) & (along - reach_along <= last) &
                    (across <= reach_across) & (across >= -reach_across);
        groups |= (Groups)meets << k;
    }
    return groups;
}

// As is_clear, if no wall outside of `groups` can block the line.
HD int is_clear_of(const HomeWalls& walls, Groups groups, Point p, Point q, float least2,
                   int* hint) {
    if (walls.n_groups > MAX_MASKED)
        return is_clear(walls, p, q, least2, hint);
    Line line = line_between(p, q, least2);
    if (*hint >= 0 && blocks(walls, *hint, line))
        return 0;
    for (; groups; groups &= groups - 1)
        if (group_blocks(walls, __builtin_ctzll(groups), line, hint))
            return 0;
    return 1;
}
