// Where an environment's objects are: at their carriers, or where they lie; and their lines.
#pragma once
#include "params.h"

HD int is_agent(int a, int n_agents) { return a >= 0 && a < n_agents; }

// The pose of object i of environment `env`: its carrier's if it has one. `positions` and `angles`
// are the agents'.
HD Pose pose_of(const ObjectsParams& o, const SceneryParams& s, const float* positions,
                const float* angles, int env, int i) {
    int carrier = o.carriers[i];
    if (!is_agent(carrier, s.n_agents))
        return pose_of(o, i);
    int agent = env * s.n_agents + carrier;
    return pose_at(positions[2 * agent], positions[2 * agent + 1], angles[agent]);
}

// Returns 1 if object i is drawn. Its size must be a number above 0, and so must its pose be
// finite, which `is_finite(sine)` tells of its angle.
HD int is_drawn(const ObjectsParams& o, const Pose& pose, int i) {
    float size = o.sizes[i];
    return is_there(o, i) && is_finite(pose.x) && is_finite(pose.y) && is_finite(pose.sine) &&
           size > 0.f && is_finite(size);
}

// Writes object i's pose, if it is carried, and flags what is wrong with it.
HD void settle(const ObjectsParams& o, const SceneryParams& s, const Pose& pose,
               const float* angles, int env, int i) {
    int carrier = o.carriers[i], layout = s.layout[env];
    if (is_agent(carrier, s.n_agents)) {
        o.positions[2 * i] = pose.x;
        o.positions[2 * i + 1] = pose.y;
        o.angles[i] = angles[env * s.n_agents + carrier];
    } else if (carrier != -1) {
        flag_object(o, i, BAD_CARRIER);
    }
    if (!is_there(o, i))
        return;
    if (!is_drawn(o, pose, i)) {
        flag_object(o, i, BAD_POSE);
        return;
    }
    // a layout that does not exist is flagged where it is rendered
    const float* extent =
        o.extents + 4 * ((unsigned int)layout < (unsigned int)s.n_layouts ? layout : 0);
    if (pose.x < extent[0] || pose.y < extent[1] || pose.x > extent[2] || pose.y > extent[3])
        flag_object(o, i, OUTSIDE);
    if ((unsigned int)o.colours[i] >= (unsigned int)o.n_colours)
        flag_object(o, i, BAD_COLOUR);
}

// The colour of object i, in full light.
HD const float* colour_of(const ObjectsParams& o, int i) {
    int colour = o.colours[i];
    return o.palette + 3 * ((unsigned int)colour < (unsigned int)o.n_colours ? colour : 0);
}

// Line l of an environment's objects as agent a sees it, of 0 m if it does not. `settles`: the
// object is settled with its first line.
HD Float4 drawn_line(const ObjectsParams& o, const SceneryParams& s, const float* positions,
                     const float* angles, int env, int a, int l, int settles) {
    int k = o.line_object[l], i = env * o.n_objects + k, first = o.line_starts[k];
    Pose pose = pose_of(o, s, positions, angles, env, i);
    if (settles && l == first)
        settle(o, s, pose, angles, env, i);
    if (!is_drawn(o, pose, i) || o.carriers[i] == a)
        return {0.f, 0.f, 0.f, 0.f};
    return line_of(o.shapes[k], l - first, o.sizes[i], pose);
}
