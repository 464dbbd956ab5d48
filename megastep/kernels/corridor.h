// Which walls could occlude a light from some part of an agent. Conservative: a wall is ruled out
// only if it lies entirely to one side of the path from the light to the agent's centre, by more
// than the agent's reach, or entirely behind the light, or entirely behind the agent.
#pragma once
#include "common/math.h"

// The path (dx, dy) from a light at (x, y) to an agent. Walls matter up to `along` in its direction
// and up to `aside` to either side; both are distances times the path's length.
struct Corridor {
    float x, y, dx, dy, along, aside;
};

HD Corridor corridor_of(float light_x, float light_y, const Pose& agent, float reach) {
    float dx = agent.x - light_x, dy = agent.y - light_y;
    float length2 = dx * dx + dy * dy;
    float wide = maxf(dx, -dx), tall = maxf(dy, -dy);
    // The path's length, overestimated by up to an eighth, plus a slack for rounding.
    float aside = reach * (maxf(wide, tall) + 0.5f * minf(wide, tall)) + 1e-3f;
    return {light_x, light_y, dx, dy, length2 + aside, aside};
}

HD int may_occlude(const Corridor& c, float ax, float ay, float bx, float by) {
    float side_a = cross(c.dx, c.dy, ax - c.x, ay - c.y);
    float side_b = cross(c.dx, c.dy, bx - c.x, by - c.y);
    float along_a = c.dx * (ax - c.x) + c.dy * (ay - c.y);
    float along_b = c.dx * (bx - c.x) + c.dy * (by - c.y);
    return !((minf(side_a, side_b) > c.aside) | (maxf(side_a, side_b) < -c.aside) |
             (maxf(along_a, along_b) < -c.aside) | (minf(along_a, along_b) > c.along));
}

// The same for the walls in a bounding box: 0 only if none of them can occlude the light.
HD int box_may_occlude(const Corridor& c, float min_x, float min_y, float max_x, float max_y) {
    float min_side = 1e9f, max_side = -1e9f;
    float min_along = 1e9f, max_along = -1e9f;
    for (int corner = 0; corner < 4; corner++) {
        float x = (corner & 1 ? max_x : min_x) - c.x;
        float y = (corner & 2 ? max_y : min_y) - c.y;
        float side = cross(c.dx, c.dy, x, y);
        float along = c.dx * x + c.dy * y;
        min_side = minf(min_side, side);
        max_side = maxf(max_side, side);
        min_along = minf(min_along, along);
        max_along = maxf(max_along, along);
    }
    return !((min_side > c.aside) | (max_side < -c.aside) | (max_along < -c.aside) |
             (min_along > c.along));
}
