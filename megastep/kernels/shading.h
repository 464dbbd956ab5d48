// Shading: where a ray hits a line, at which angle, and the colour there.
#pragma once
#include "draw_objects.h"
#include "raster.h"

struct EnvScenery {
    const float* agent_lines;
    const float* agent_textures;
    const float* agent_light;
    int first_box, first_wall, n_walls, n_agent_lines, first_texel;
};

HD EnvScenery env_scenery(const SceneryParams& s, int env, int layout) {
    int first = s.wall_starts[layout];
    int n_agent_lines = s.n_agents * s.n_model;
    return {s.agent_lines + 4 * (env * (long long)n_agent_lines),
            s.agent_textures + 3 * (layout * (long long)s.n_agent_texels),
            s.agent_light + env * (long long)s.n_agent_texels,
            s.box_starts[layout],
            first,
            s.wall_starts[layout + 1] - first,
            n_agent_lines,
            s.texel_starts[first]};
}

// What is drawn beside walls, a bit each.
constexpr int AGENTS = 1;
constexpr int OBJECTS = 2;

// The first wall's index among an environment's lines.
template <int drawn>
HD int first_static_line(const RenderParams& p, const EnvScenery& scenery) {
    return drawn & OBJECTS ? scenery.n_agent_lines + p.objects.n_lines : scenery.n_agent_lines;
}

// A line hit by rays: its start and direction in the camera's frame, and its texels. `kind`: 0 of a
// wall, AGENTS, OBJECTS.
struct Surface {
    float ax, ay, vx, vy;
    int first_texel, width, kind;
};

// Line l of an environment: agents' come first, then objects', then walls. Of what is drawn, it may
// be one of those `hit`. `objects`: as drawn by draw_line.
template <int drawn, int hit = drawn>
HD Surface surface_of(const RenderParams& p, const EnvScenery& scenery, const Pose& camera, int l,
                      const Float4* objects) {
    const SceneryParams& s = p.scenery;
    float ax, ay, bx, by;
    if (hit & OBJECTS && l >= scenery.n_agent_lines && l < first_static_line<drawn>(p, scenery)) {
        int i = l - scenery.n_agent_lines;
        to_camera(camera, objects[i].x, objects[i].y, ax, ay);
        to_camera(camera, objects[i].z, objects[i].w, bx, by);
        return {ax, ay, bx - ax, by - ay, object_of(p.objects, i), 1, OBJECTS};
    }
    int is_agent = hit & AGENTS && l < scenery.n_agent_lines;
    int i = is_agent ? l : l + (scenery.first_wall - first_static_line<drawn>(p, scenery));
    Float4 line = LOAD((const Float4*)(is_agent ? scenery.agent_lines : s.walls) + i);
    const int* starts = (is_agent ? s.model_texels : s.texel_starts) + i;
    to_camera(camera, line.x, line.y, ax, ay);
    to_camera(camera, line.z, line.w, bx, by);
    return {ax, ay, bx - ax, by - ay, starts[0], starts[1] - starts[0], is_agent};
}

// `location`: fraction along the line. `facing`: squared sine between ray and line.
struct Hit {
    float location, facing;
};

// Where the ray along (1, y), of `length` at unit depth, hits a line. One division serves both
// fields.
HD Hit hit_of(const Surface& line, float y, float length) {
    float across = line.vy - y * line.vx;
    float size = length * length * (line.vx * line.vx + line.vy * line.vy);
    float inverse = RECIPROCAL(across * size);
    Hit hit;
    hit.location = clamp((y * line.ax - line.ay) * size * inverse, 0.f, 1.f);
    hit.facing = across * across * (across * inverse);
    return hit;
}

HD float cosine_of(const Surface& line, float y, float length) {
    float size = SQRT(line.vx * line.vx + line.vy * line.vy);
    return (line.vx + y * line.vy) / (length * size + 1e-6f);
}

// Linear filtering between texel centres, clamped at the ends of the line.
struct Filter {
    int left, right;
    float weight;
};

HD Filter filter_at(float location, int width) {
    float at = location * (float)width - 0.5f;
    float floor = FLOOR(at);
    return {maxi((int)floor, 0), mini((int)floor + 1, width - 1), at - floor};
}

HD int texel_at(float location, int width) {
    return mini((int)(location * (float)width), width - 1);
}

struct Colour {
    float red, green, blue;
};

// Interpolates two texels (red, green, blue, light) and applies the light.
HD Colour blend(const Float4 left, const Float4 right, float weight, float facing) {
    float light = mix(left.w, right.w, weight) * facing;
    return {mix(left.x, right.x, weight) * light, mix(left.y, right.y, weight) * light,
            mix(left.z, right.z, weight) * light};
}

HD Colour wall_colour(const SceneryParams& s, int first, int width, const Hit& hit) {
    Filter f = filter_at(hit.location, width);
    const Float4* texels = (const Float4*)s.texels;
    return blend(LOAD(texels + (first + f.left)), LOAD(texels + (first + f.right)), f.weight,
                 hit.facing);
}

HD Float4 agent_texel(const EnvScenery& scenery, int texel) {
    const float* colour = scenery.agent_textures + 3 * texel;
    return {colour[0], colour[1], colour[2], scenery.agent_light[texel]};
}

HD Colour agent_colour(const EnvScenery& scenery, int first, int width, const Hit& hit) {
    Filter f = filter_at(hit.location, width);
    return blend(agent_texel(scenery, first + f.left), agent_texel(scenery, first + f.right),
                 f.weight, hit.facing);
}

// An object has one texel, which all its lines show.
HD Colour object_colour(const Float4& texel, float facing) {
    float light = texel.w * facing;
    return {texel.x * light, texel.y * light, texel.z * light};
}
