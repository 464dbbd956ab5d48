// Swept collision tests: a disc that moves in a straight line against a point or a segment.
#pragma once
#include "common/math.h"

constexpr float NO_CONTACT = 2.f;  // beyond the end of the step

// The step that an agent really makes once its new position is rounded to a float. Collisions are
// tested along this step.
HD float displacement(float from, float velocity, float seconds) {
    return (from + velocity * seconds) - from;
}

// The fraction of the step d after which a point at g enters a disc of radius rho about the origin,
// or NO_CONTACT. A point that starts inside enters at 0 if it approaches the centre, and otherwise
// never.
HD float sweep_point(float gx, float gy, float dx, float dy, float rho) {
    float approach = -(gx * dx + gy * dy);
    float outside = gx * gx + gy * gy - rho * rho;
    if (!(approach > 0.f))
        return NO_CONTACT;
    if (outside < 0.f)
        return 0.f;
    float offset = cross(gx, gy, dx, dy);
    float discriminant = rho * rho * (dx * dx + dy * dy) - offset * offset;
    if (discriminant < 0.f)
        return NO_CONTACT;
    return outside / (approach + SQRT(discriminant));
}

// Returns 1 if the bounding boxes of a swept disc and of a segment overlap. A cheap test that rules
// out nearly all walls.
HD int boxes_meet(float px, float py, float dx, float dy, float ax, float ay, float bx, float by,
                  float rho) {
    return (minf(ax, bx) <= maxf(px, px + dx) + rho) & (maxf(ax, bx) >= minf(px, px + dx) - rho) &
           (minf(ay, by) <= maxf(py, py + dy) + rho) & (maxf(ay, by) >= minf(py, py + dy) - rho);
}

// The fraction of the step d after which a disc of radius rho at p touches the segment ab, or
// NO_CONTACT. A disc that already overlaps the segment is stopped if it comes closer, and free if
// it moves away: along a straight path, the distance to a convex body never shrinks again once it
// has grown. If rounding cannot tell whether the disc is beside the segment or beyond its end, both
// cases are tested.
HD float sweep_segment(float px, float py, float dx, float dy, float ax, float ay, float bx,
                       float by, float rho) {
    if (!boxes_meet(px, py, dx, dy, ax, ay, bx, by, rho))
        return NO_CONTACT;
    float ex = bx - ax, ey = by - ay;  // the segment
    float gx = px - ax, gy = py - ay;  // the disc relative to each end
    float hx = px - bx, hy = py - by;
    float length2 = ex * ex + ey * ey;
    float along = gx * ex + gy * ey;
    float slack = 1e-6f * (length2 + maxf(gx * ex, -gx * ex) + maxf(gy * ey, -gy * ey));
    float height = cross(ex, ey, gx, gy);  // above the segment's line, times the segment's length
    float climb = cross(ex, ey, dx, dy);
    if (height < 0.f) {
        height = -height;
        climb = -climb;
    }
    float gap = height - rho * SQRT(length2);
    float nx = along > 0.f ? hx : gx;  // relative to the end that the disc may be beyond
    float ny = along > 0.f ? hy : gy;
    int nearing = along > -slack && along < length2 + slack && climb < 0.f;
    int beyond = !(along > 0.f && along < length2);
    int overlaps_end = beyond && nx * nx + ny * ny < rho * rho;
    int overlaps = overlaps_end || (!beyond && gap < 0.f);
    if ((nearing && gap < 0.f) || (overlaps_end && nx * dx + ny * dy < 0.f))
        return 0.f;
    if (overlaps && !nearing)
        return NO_CONTACT;
    float first = minf(sweep_point(gx, gy, dx, dy, rho), sweep_point(hx, hy, dx, dy, rho));
    if (gap >= 0.f && climb < 0.f) {
        float t = gap / -climb;
        float foot = along + t * (dx * ex + dy * ey);
        if (foot >= -slack && foot <= length2 + slack)
            first = minf(first, t);
    }
    return first;
}
