// Can one agent see another? A wall between them cuts the line of sight to the other's middle and
// those to both sides of its disc, or it can. What shows through a gap between two of the lines, as
// narrow as an agent's radius, is overlooked.
#pragma once
#include "common.h"
#include "scenery.h"

// Does the wall ab cut the line from (x, y) along d? Without a division, and ends count, so that
// nothing is seen between two walls that share a corner.
HD int cuts(float ax, float ay, float bx, float by, float x, float y, float dx, float dy) {
    float vx = bx - ax, vy = by - ay, px = x - ax, py = y - ay;
    float side_a = cross(dx, dy, ax - x, ay - y), side_b = cross(dx, dy, bx - x, by - y);
    float near_side = cross(vx, vy, px, py), far_side = cross(vx, vy, px + dx, py + dy);
    return (minf(side_a, side_b) <= 0.f) & (maxf(side_a, side_b) >= 0.f) &
           (minf(near_side, far_side) <= 0.f) & (maxf(near_side, far_side) >= 0.f) &
           (cross(dx, dy, vx, vy) != 0.f);
}

// Who works on an environment together. The CPU's threads, and a GPU's if it gives each environment
// one, work alone.
struct Alone {
    static constexpr int SIZE = 1;
    int rank;
};

HD void sync(const Alone&) {}

HD unsigned int unite(const Alone&, unsigned int bits) { return bits; }

// Is a disc at (x + dx, y + dy) in sight of (x, y)? `crew` looks at the walls together.
template <class Crew>
HD int in_sight(const SceneryParams& s, const Crew& crew, const Walls& walls, float x, float y,
                float dx, float dy) {
    float wide = s.radius / maxf(SQRT(dx * dx + dy * dy), s.radius);
    float side_x = -wide * dy, side_y = wide * dx;
    unsigned int cut = 0;
    for (int i = walls.first_wall + crew.rank; i < walls.end_wall && cut != 7; i += Crew::SIZE) {
        Float4 wall = LOAD((const Float4*)s.walls + i);
        for (int line = 0; line < 3; line++) {
            float aside = (float)(line - 1);
            cut |= (unsigned int)cuts(wall.x, wall.y, wall.z, wall.w, x, y, dx + aside * side_x,
                                      dy + aside * side_y)
                   << line;
        }
    }
    return unite(crew, cut) != 7;
}
