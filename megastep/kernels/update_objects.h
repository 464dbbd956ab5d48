// Where an environment's objects are drawn, and in which light.
#pragma once
#include "draw_objects.h"
#include "light.h"

constexpr int NOBODY = -2;  // no agent, nor a carrier

// Moves object i, of all environments', to its carrier, if any, and writes its lines and its texel.
HD void update_object(const UpdateObjectsParams& p, int i) {
    const ObjectsParams& o = p.objects;
    const SceneryParams& s = p.scenery;
    int env = i / o.n_objects, k = i % o.n_objects;
    int layout = layout_of(s, env, p.error_flag);
    Object object = placed(objects_of(o)[i], s, p.positions, p.angles, env);
    settle(o, s, object, layout, i, p.error_flag);
    Float4* lines = (Float4*)o.lines + env * (long long)o.n_lines;
    Range own = lines_of(o, k);
    for (int l = own.first; l < own.end; l++)
        lines[l] = seen_line(o, object, l, NOBODY);
    float light = o.lit && is_drawn(object) ? light_at(s, layout, object.x, object.y) : 1.f;
    ((Float4*)o.texels)[i] = texel_of(o, object, light);
}

EACH(update_objects, UpdateObjectsParams, (p.scenery.n_envs * p.objects.n_objects),
     threads_for(p.scenery, n, 1024), update_object(p, i))
