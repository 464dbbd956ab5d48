// Where an environment's objects are: at their carriers, or where they lie; and their lines.
#pragma once
#include "params.h"

HD int is_agent(int a, int n_agents) { return a >= 0 && a < n_agents; }

// An object of environment `env`, at its carrier if it has one. `positions` and `angles` are the
// agents'.
HD Object placed(const Object& object, const SceneryParams& s, const float* positions,
                 const float* angles, int env) {
    Object result = object;
    if (is_agent(object.carrier, s.n_agents)) {
        int agent = env * s.n_agents + object.carrier;
        result.x = positions[2 * agent];
        result.y = positions[2 * agent + 1];
        result.angle = angles[agent];
    }
    return result;
}

HD int is_drawn(const Object& object) {
    return is_there(object) && is_finite(object.x) && is_finite(object.y) &&
           is_finite(object.angle) && object.size > 0.f && is_finite(object.size);
}

// Writes object i's pose, if it is carried, and flags what is wrong with it. `object` is as placed.
HD void settle(const ObjectsParams& o, const SceneryParams& s, const Object& object, int layout,
               int i, int* error_flag) {
    if (is_agent(object.carrier, s.n_agents)) {
        objects_of(o)[i].x = object.x;
        objects_of(o)[i].y = object.y;
        objects_of(o)[i].angle = object.angle;
    } else if (object.carrier != -1) {
        flag_error(error_flag, i, BAD_CARRIER);
    }
    if (!is_there(object))
        return;
    Float4 extent = LOAD((const Float4*)o.extents + layout);
    if (!is_drawn(object))
        flag_error(error_flag, i, BAD_POSE);
    else if (object.x < extent.x || object.y < extent.y || object.x > extent.z ||
             object.y > extent.w)
        flag_error(error_flag, i, OUTSIDE);
    else if ((unsigned int)object.colour >= (unsigned int)o.n_colours)
        flag_error(error_flag, i, BAD_COLOUR);
}

HD Float4 texel_of(const ObjectsParams& o, const Object& object, float light) {
    int exists = (unsigned int)object.colour < (unsigned int)o.n_colours;
    const float* rgb = o.palette + 3 * (exists ? object.colour : 0);
    return {rgb[0], rgb[1], rgb[2], light};
}

// Line l, of a placed object, as agent a sees it, of 0 m if it does not: nobody sees what it
// carries.
HD Float4 seen_line(const ObjectsParams& o, const Object& object, int l, int a) {
    if (!is_drawn(object) || object.carrier == a)
        return {0.f, 0.f, 0.f, 0.f};
    return line_of(o, l, object, pose_at(object.x, object.y, object.angle));
}
