// Where an environment's objects are drawn, and in which light.
#pragma once
#include "draw_objects.h"
#include "light.h"
#include "params.h"

constexpr int NOBODY = -2;  // no agent, nor a carrier

// The light at a point, as light_at of light_cpu.h.
HD float light_on(const SceneryParams& s, int layout, float x, float y) {
    float sum = AMBIENT;
    for (int l = s.light_starts[layout]; l < s.light_starts[layout + 1]; l++) {
        const float* light = s.lights + 3 * l;
        float dx = x - light[0], dy = y - light[1];
        int is_lit = 1;
        for (int i = s.wall_starts[layout]; is_lit && i < s.wall_starts[layout + 1]; i++) {
            Float4 wall = LOAD((const Float4*)s.walls + i);
            Occluder occluder = occluder_of(light[0], light[1], wall.x, wall.y, wall.z, wall.w);
            is_lit = !occludes(occluder, dx, dy);
        }
        if (is_lit)
            sum += irradiance(light[2], dx, dy);
    }
    return minf(sum, 1.f);
}

// Moves object i, of all environments', to its carrier, if any, and writes its lines and its texel.
HD void update_object(const UpdateObjectsParams& p, int i) {
    const ObjectsParams& o = p.objects;
    const SceneryParams& s = p.scenery;
    int env = i / o.n_objects, k = i % o.n_objects;
    int layout = s.layout[env];
    if ((unsigned int)layout >= (unsigned int)s.n_layouts)
        layout = 0;  // which is flagged where it is rendered
    Object object = placed(objects_of(o)[i], s, p.positions, p.angles, env);
    settle(o, s, object, layout, i);
    Float4* lines = (Float4*)o.lines + env * (long long)o.n_lines;
    for (int l = o.line_starts[k]; l < o.line_starts[k + 1]; l++)
        lines[l] = seen_line(o, object, l, NOBODY);
    float light = o.lit && is_drawn(object) ? light_on(s, layout, object.x, object.y) : 1.f;
    ((Float4*)o.texels)[i] = texel_of(o, object, light);
}

EACH(update_objects, UpdateObjectsParams, (p.scenery.n_envs * p.objects.n_objects),
     threads_for(p.scenery, n, 1024), update_object(p, i))
