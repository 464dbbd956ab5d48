// Which walls could occlude a light from some part of an agent. Conservative: a wall is ruled out
// only if, by a margin for rounding, all of it lies to one side of the path from the light to the
// agent, or the light and the whole agent lie on the same side of it. All texels of an agent are
// within `reach` of its centre.
#pragma once
#include "common/math.h"

constexpr float MARGIN = 1e-3f;  // of distances in metres, and of areas in square metres

// A vector's length, overestimated by up to an eighth.
HD float length_at_most(float x, float y) {
    float wide = ABS(x), tall = ABS(y);
    return maxf(wide, tall) + 0.5f * minf(wide, tall);
}

// The path (dx, dy) from a light to an agent's centre. Walls matter up to half of `width` to either
// side of it, which is a distance times the path's length.
struct Corridor {
    float dx, dy, width;
};

HD Corridor corridor_of(float light_x, float light_y, const Pose& agent, float reach) {
    float dx = agent.x - light_x, dy = agent.y - light_y;
    return {dx, dy, 2.f * (reach * length_at_most(dx, dy) + MARGIN)};
}

// A box around a light and all of an agent's texels: min x, min y, max x, max y.
HD Float4 bounds_of(float light_x, float light_y, const Pose& agent, float reach) {
    float aside = reach + MARGIN;
    return {minf(light_x, agent.x) - aside, minf(light_y, agent.y) - aside,
            maxf(light_x, agent.x) + aside, maxf(light_y, agent.y) + aside};
}

HD int overlap(const Float4& box, const Float4& other) {
    return (box.x <= other.z) & (box.y <= other.w) & (box.z >= other.x) & (box.w >= other.y);
}

// A wall's ends a and b relative to an agent's centre, in the order in which a x b is not negative.
// It cannot occlude a light from the agent if side_b - side_a of may_occlude exceeds `limit`.
struct FacingWall {
    float ax, ay, bx, by, limit;
};

HD FacingWall no_wall() { return {0.f, 0.f, 0.f, 0.f, -INF_VALUE}; }

// The area w x v of a wall v that begins at w from a point tells on which side of the wall the
// point is. From an agent to a light, it changes by side_b - side_a. There is no limit if the
// wall's line may cut the agent.
HD FacingWall facing_wall(const Float4& wall, const Pose& agent, float reach) {
    float ax = wall.x - agent.x, ay = wall.y - agent.y;
    float bx = wall.z - agent.x, by = wall.w - agent.y;
    float vx = wall.z - wall.x, vy = wall.w - wall.y;
    float signed_area = cross(ax, ay, vx, vy);
    float area = ABS(signed_area);
    float limit = area > reach * length_at_most(vx, vy) + MARGIN ? MARGIN - area : INF_VALUE;
    if (signed_area < 0.f)
        return {bx, by, ax, ay, limit};
    return {ax, ay, bx, by, limit};
}

// Returns 0 only if the wall cannot occlude the light from any part of the agent.
HD int may_occlude(const Corridor& corridor, const FacingWall& wall) {
    float side_a = cross(corridor.dx, corridor.dy, wall.ax, wall.ay);
    float side_b = cross(corridor.dx, corridor.dy, wall.bx, wall.by);
    float turn = side_b - side_a;
    return (turn <= wall.limit) & (ABS(side_a + side_b) <= ABS(turn) + corridor.width);
}
