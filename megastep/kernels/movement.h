// How agents move: a step is cut short where the agent's disc, swept along it, touches a wall or
// another agent's disc.
#pragma once
#include "common.h"
#include "errors.h"
#include "params.h"

constexpr float NO_CONTACT = 2.f;    // beyond the end of the step
constexpr float INFLATION = 1.001f;  // of the radius: a stopped camera stays on its side of a wall
constexpr float SHORTENING = 0.99f;  // of the free part of a step

// What rounding leaves of a step, so that the path that is tested is the path that is taken.
HD float displacement(float from, float velocity, float seconds) {
    return (from + velocity * seconds) - from;
}

// Fraction of the step d after which a point at g, relative to a disc of radius rho about the
// origin, enters the disc. A point inside enters at 0 if it nears the centre, and else never.
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

// Do the bounding boxes of a swept disc and of a segment meet? Cheap, and rules out nearly all
// walls.
HD int boxes_meet(float px, float py, float dx, float dy, float ax, float ay, float bx, float by,
                  float rho) {
    return (minf(ax, bx) <= maxf(px, px + dx) + rho) & (maxf(ax, bx) >= minf(px, px + dx) - rho) &
           (minf(ay, by) <= maxf(py, py + dy) + rho) & (maxf(ay, by) >= minf(py, py + dy) - rho);
}

// Fraction of the step d after which a disc of radius rho at p touches the segment ab, or
// NO_CONTACT. The distance to a convex body along a straight path, once it grows, grows for ever:
// so a disc that overlaps the segment is held if it comes nearer and free if it leaves. Where
// rounding cannot tell whether the disc is beside the segment or beyond its end, it is taken for
// both.
HD float sweep_segment(float px, float py, float dx, float dy, float ax, float ay, float bx,
                       float by, float rho) {
    if (!boxes_meet(px, py, dx, dy, ax, ay, bx, by, rho))
        return NO_CONTACT;
    float ex = bx - ax, ey = by - ay;  // the segment
    float gx = px - ax, gy = py - ay;  // the disc from either end
    float hx = px - bx, hy = py - by;
    float length2 = ex * ex + ey * ey;
    float along = gx * ex + gy * ey;
    float slack = 1e-6f * (length2 + maxf(gx * ex, -gx * ex) + maxf(gy * ey, -gy * ey));
    float height = cross(ex, ey, gx, gy);  // above the segment's line, times its length
    float climb = cross(ex, ey, dx, dy);
    if (height < 0.f) {
        height = -height;
        climb = -climb;
    }
    float gap = height - rho * SQRT(length2);
    float nx = along > 0.f ? hx : gx;  // from the end that the disc may lie beyond
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

// Fraction of the step d after which an agent at p touches agent k, which moves at the same time.
HD float sweep_agent(const PhysicsParams& p, int k, float px, float py, float dx, float dy,
                     float rho) {
    float kx = p.positions[2 * k], ky = p.positions[2 * k + 1];
    float other_dx = displacement(kx, p.velocity[2 * k], p.seconds);
    float other_dy = displacement(ky, p.velocity[2 * k + 1], p.seconds);
    return sweep_point(px - kx, py - ky, dx - other_dx, dy - other_dy, 2.f * rho);
}

HD float progress_of(float contact) {
    return contact <= 1.f ? clamp(SHORTENING * contact, 0.f, 1.f) : 1.f;
}

// Agent a takes its action: velocities are damped, and the action's, turned to the agent's heading,
// are added.
HD void apply_action(const PhysicsParams& p, int env, int a) {
    int i = env * p.scenery.n_agents + a;
    long long action = p.actions[i];
    if (action < 0 || action >= p.n_moves) {
        flag_error(p.error_flag, env, BAD_ACTION);
        action = 0;
    }
    const float* move = p.moves + 3 * action;
    float s, c;
    sincos_degrees(p.angles[i], s, c);
    float* velocity = p.velocity + 2 * i;
    velocity[0] = p.retained * velocity[0] + (c * move[0] - s * move[1]);
    velocity[1] = p.retained * velocity[1] + (s * move[0] + c * move[1]);
    p.angvelocity[i] = p.retained * p.angvelocity[i] + move[2];
}

// Agent a takes the free part of its step; if something stopped it, its velocities are 0.
HD void advance(const PhysicsParams& p, int env, int a) {
    int i = env * p.scenery.n_agents + a;
    float progress = p.progress[i];
    float* position = p.positions + 2 * i;
    float* velocity = p.velocity + 2 * i;
    position[0] += progress * displacement(position[0], velocity[0], p.seconds);
    position[1] += progress * displacement(position[1], velocity[1], p.seconds);
    p.angles[i] = wrap_degrees(p.angles[i] + progress * (p.angvelocity[i] * p.seconds));
    flag_nonfinite(p.error_flag, env, position[0], position[1], p.angles[i]);
    if (progress < 1.f) {
        velocity[0] = 0.f;
        velocity[1] = 0.f;
        p.angvelocity[i] = 0.f;
    }
}
