// Where an environment's objects are drawn, and in which light.
#pragma once
#include "light.h"
#include "params.h"

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
    int env = i / o.n_objects, k = i % o.n_objects, n_agents = p.scenery.n_agents;
    int carrier = o.carriers[i], shape = o.shapes[k], colour = o.colours[i];
    float* position = o.positions + 2 * i;
    if (carrier >= n_agents || carrier < -1) {
        flag_object(o, i, BAD_CARRIER);
    } else if (carrier >= 0) {
        int agent = env * n_agents + carrier;
        position[0] = p.positions[2 * agent];
        position[1] = p.positions[2 * agent + 1];
        o.angles[i] = p.angles[agent];
    }
    float x = position[0], y = position[1], size = o.sizes[i];
    int is_drawn = is_there(o, i);
    if (is_drawn && !(is_finite(x) && is_finite(y) && is_finite(o.angles[i]) && size > 0.f &&
                      is_finite(size))) {
        flag_object(o, i, BAD_POSE);
        is_drawn = 0;
    }
    Float4* lines = (Float4*)o.lines + (env * (long long)o.n_lines + o.line_starts[k]);
    Pose pose = pose_of(o, i);
    for (int line = 0; line < n_lines_of(shape); line++)
        lines[line] = is_drawn ? line_of(shape, line, size, pose) : Float4{0.f, 0.f, 0.f, 0.f};
    if (!is_drawn)
        return;
    int layout = p.scenery.layout[env];
    if ((unsigned int)layout >= (unsigned int)p.scenery.n_layouts)
        layout = 0;  // which is flagged where it is rendered
    const float* extent = o.extents + 4 * layout;
    if (x < extent[0] || y < extent[1] || x > extent[2] || y > extent[3])
        flag_object(o, i, OUTSIDE);
    if ((unsigned int)colour >= (unsigned int)o.n_colours) {
        flag_object(o, i, BAD_COLOUR);
        colour = 0;
    }
    const float* rgb = o.palette + 3 * colour;
    float light = o.lit ? light_on(p.scenery, layout, x, y) : 1.f;
    ((Float4*)o.texels)[i] = {rgb[0], rgb[1], rgb[2], light};
}
