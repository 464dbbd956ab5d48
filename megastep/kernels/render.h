// The outputs of `render`: rays at full resolution, pixels (means of rays), newly seen texels, IMU.
#pragma once
#include "shading.h"

// Writes component k of an agent's IMU: angular velocity / 360, own velocity ahead / 10 and left
// / 10.
HD void write_imu(const RenderParams& p, int agent, int k) {
    float x = p.velocity[2 * agent], y = p.velocity[2 * agent + 1];
    float turning = p.angvelocity[agent];
    float s, c;
    sincos_degrees(p.angles[agent], s, c);
    float ahead = c * x + s * y, left = c * y - s * x;
    float value = k == 0 ? turning * (1.f / 360.f) : (k == 1 ? ahead : left) * (1.f / 10.f);
    p.imu[3 * (long long)agent + k] = HALF_BITS(value);
}

// Marks a texel as seen and returns 1 if it was not before. Most are seen already, so it reads
// first.
HD int mark_seen(unsigned int* seen, int texel) {
    unsigned int bit = 1u << (texel & 31);
    return !(seen[texel >> 5] & bit) && !(OR_BITS(seen + (texel >> 5), bit) & bit);
}

// Falls from 1 at the agent's radius to 0 at max_depth beyond it.
HD float depth_reading(float distance, float radius, float inv_max_depth) {
    return 1.f - clamp((distance - radius) * inv_max_depth, 0.f, 1.f);
}

HD Object object_at(const RenderParams& p, int env, int k) {
    const Object& object = objects_of(p.objects)[env * p.objects.n_objects + k];
    return placed(object, p.scenery, p.positions, p.angles, env);
}

// Draws the texel of an environment's object k into `drawn`, after all lines.
HD void draw_texel(const RenderParams& p, const Object& object, int env, int k, Float4* drawn) {
    const ObjectsParams& o = p.objects;
    int i = env * o.n_objects + k;
    drawn[o.n_lines + k] = texel_of(o, object, o.lit ? o.texels[4 * i + 3] : 1.f);
}

// What a ray contributes to its pixel.
struct RaySample {
    float red, green, blue, depth;
};

// Writes a ray that hits no line. `ray` is its index over all cameras.
HD void write_miss(const RenderParams& p, long long ray) {
    if (p.locations)
        p.locations[ray] = NAN_VALUE;
    if (p.dots)
        p.dots[ray] = NAN_VALUE;
    if (p.distances)
        p.distances[ray] = INF_VALUE;
    if (p.screen) {
        float* rgb = p.screen + 3 * ray;
        rgb[0] = 0.f;
        rgb[1] = 0.f;
        rgb[2] = 0.f;
    }
}

template <int drawn>
HD Colour moving_colour(const RenderParams& p, const EnvScenery& scenery, const Surface& surface,
                        const Hit& hit, const Float4* objects) {
    if (drawn & OBJECTS && surface.kind == OBJECTS)
        return object_colour(objects[p.objects.n_lines + surface.first_texel], hit.facing);
    return agent_colour(scenery, surface.first_texel, surface.width, hit);
}

// Shades ray r of camera `view`, which hits a surface at this inverse depth. Writes the
// full-resolution outputs if `full_res`, and adds to newly_seen a texel that is seen for the first
// time.
template <int full_res, int drawn>
HD RaySample shade_ray(const RenderParams& p, const Screen& screen, const EnvScenery& scenery,
                       const Surface& surface, const Float4* objects, int view, unsigned int* seen,
                       int r, float inverse_depth, int& newly_seen) {
    float y = ray_slope(screen, r), length = p.ray_lengths[r];
    float distance = length * RECIPROCAL(inverse_depth);
    int first = surface.first_texel, width = surface.width;
    Hit hit = hit_of(surface, y, length);
    RaySample sample = {0.f, 0.f, 0.f, depth_reading(distance, screen.radius, p.inv_max_depth)};
    if (p.rgb || (full_res && p.screen)) {
        Colour colour = surface.kind ? moving_colour<drawn>(p, scenery, surface, hit, objects)
                                     : wall_colour(p.scenery, first, width, hit);
        sample.red = colour.red;
        sample.green = colour.green;
        sample.blue = colour.blue;
    }
    if (seen && !surface.kind)
        newly_seen += mark_seen(seen, first - scenery.first_texel + texel_at(hit.location, width));
    if (!full_res)
        return sample;
    long long ray = (long long)view * p.res + r;
    if (p.screen) {
        float* rgb = p.screen + 3 * ray;
        rgb[0] = sample.red;
        rgb[1] = sample.green;
        rgb[2] = sample.blue;
    }
    if (p.locations)
        p.locations[ray] = hit.location;
    if (p.dots)
        p.dots[ray] = cosine_of(surface, y, length);
    if (p.distances)
        p.distances[ray] = distance;
    return sample;
}

// Writes a pixel: the mean of its rays. Rays are summed in order, except that four rays, the usual
// number, are summed in pairs.
HD void write_pixel(const RenderParams& p, int view, int pixel, const RaySample& sum) {
    int n_pixels = p.n_pixels;
    float inv_subsample = p.inv_subsample;
    if (p.rgb) {
        unsigned short* rgb = p.rgb + (long long)view * (3 * n_pixels) + pixel;
        rgb[0] = HALF_BITS(sum.red * inv_subsample);
        rgb[n_pixels] = HALF_BITS(sum.green * inv_subsample);
        rgb[2 * n_pixels] = HALF_BITS(sum.blue * inv_subsample);
    }
    if (p.depth)
        p.depth[(long long)view * n_pixels + pixel] = HALF_BITS(sum.depth * inv_subsample);
}
