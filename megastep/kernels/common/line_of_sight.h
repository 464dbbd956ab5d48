// Tests if one agent can see another, along three lines of sight: to the other's centre and to both
// sides of its disc. The other is hidden if walls cut all three. A gap between walls narrower than
// an agent's radius, which falls between two lines, may be missed.
#pragma once
#include "common/group.h"
#include "common/objects.h"

// Returns 1 if the wall ab cuts the line from (x, y) to (x + dx, y + dy). A wall's ends count, so
// that no line passes between two walls that share a corner. Needs no division.
HD int cuts(float ax, float ay, float bx, float by, float x, float y, float dx, float dy) {
    float vx = bx - ax, vy = by - ay, px = x - ax, py = y - ay;
    float side_a = cross(dx, dy, ax - x, ay - y), side_b = cross(dx, dy, bx - x, by - y);
    float near_side = cross(vx, vy, px, py), far_side = cross(vx, vy, px + dx, py + dy);
    return (minf(side_a, side_b) <= 0.f) & (maxf(side_a, side_b) >= 0.f) &
           (minf(near_side, far_side) <= 0.f) & (maxf(near_side, far_side) >= 0.f) &
           (cross(dx, dy, vx, vy) != 0.f);
}

// The three lines of sight, from (x, y) to (x + dx, y + dy) and to both sides of it, that a wall
// cuts: a bit for each.
HD unsigned int cut_by(const Float4& wall, float x, float y, float dx, float dy, float side_x,
                       float side_y) {
    unsigned int cut = 0;
    for (int line = 0; line < 3; line++) {
        float aside = (float)(line - 1);
        cut |= (unsigned int)cuts(wall.x, wall.y, wall.z, wall.w, x, y, dx + aside * side_x,
                                  dy + aside * side_y)
               << line;
    }
    return cut;
}

template <class Group>
HD unsigned int cut_by_objects(const ObjectsParams& o, const Group& group, int env, float x,
                               float y, float dx, float dy, float side_x, float side_y) {
    unsigned int cut = 0;
    for (int k = group.rank; k < o.n_objects; k += Group::SIZE) {
        Object object = objects_of(o)[env * o.n_objects + k];
        if (!is_obstacle(object))
            continue;
        Pose pose = pose_at(object.x, object.y, object.angle);
        Range lines = lines_of(o, k);
        for (int l = lines.first; l < lines.end; l++)
            cut |= cut_by(line_of(o, l, object, pose), x, y, dx, dy, side_x, side_y);
    }
    return cut;
}

// Returns 1 if a disc of the agents' radius at (x + dx, y + dy) is visible from (x, y). The threads
// of `group` divide the walls, and environment `env`'s objects, among them.
template <int with_objects, class Group>
HD int is_visible(const SceneryParams& s, const ObjectsParams& o, const Group& group,
                  const Walls& walls, int env, float x, float y, float dx, float dy) {
    float wide = s.radius / maxf(SQRT(dx * dx + dy * dy), s.radius);
    float side_x = -wide * dy, side_y = wide * dx;
    unsigned int cut = 0;
    for (int i = walls.first_wall + group.rank; i < walls.end_wall && cut != 7; i += Group::SIZE)
        cut |= cut_by(LOAD((const Float4*)s.walls + i), x, y, dx, dy, side_x, side_y);
    if (with_objects)
        cut |= cut_by_objects(o, group, env, x, y, dx, dy, side_x, side_y);
    return reduce_or(group, cut) != 7;
}
