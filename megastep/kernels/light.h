// Irradiance: ambient light, and the light of each lamp that no wall of the layout occludes.
#pragma once
#include "common/scenery.h"

constexpr float AMBIENT = 0.1f;

// The irradiance at (dx, dy) metres from a light; closer than 1 m it stays constant.
HD float irradiance(float intensity, float dx, float dy) {
    return 2.f * intensity / maxf(dx * dx + dy * dy, 1.f);
}

// A wall relative to a light: its direction v, and its start w from the light. Both are negated if
// necessary so that `area` = w x v is not negative. A wall of area 0 points at the light and
// occludes nothing.
struct Occluder {
    float vx, vy, wx, wy, area;
};

HD Occluder occluder_of(float light_x, float light_y, float ax, float ay, float bx, float by) {
    float vx = bx - ax, vy = by - ay;
    float wx = ax - light_x, wy = ay - light_y;
    float area = cross(wx, wy, vx, vy);
    float sign = area < 0.f ? -1.f : 1.f;
    return {sign * vx, sign * vy, sign * wx, sign * wy, sign * area};
}

// Returns 1 if the wall cuts the segment from the light to a texel at d. The segment's last
// thousandth does not count, since the wall of the texel itself lies there. Needs no division: both
// sides are multiplied by the determinant.
HD int occludes(const Occluder& wall, float dx, float dy) {
    float determinant = cross(dx, dy, wall.vx, wall.vy);
    float u = cross(wall.wx, wall.wy, dx, dy);
    return (wall.area > 0.f) & (wall.area < 0.999f * determinant) & (u >= 0.f) & (u <= determinant);
}

// The centre of texel k of a line that has `width` texels.
HD void texel_centre(const float* line, int k, int width, float& x, float& y) {
    float u = ((float)k + 0.5f) / (float)width;
    x = mix(line[0], line[2], u);
    y = mix(line[1], line[3], u);
}

// Returns 1 if any of n walls occludes the light from a point at (dx, dy) from it.
HD int is_occluded(const float* walls, int n, const float* light, float dx, float dy) {
    for (int start = 0; start < n; start += SIMD_STEPS) {
        int end = mini(start + SIMD_STEPS, n), occluded = 0;
        SIMD_OR(occluded)
        for (int j = start; j < end; j++) {
            const float* wall = walls + 4 * j;
            occluded |= occludes(
                occluder_of(light[0], light[1], wall[0], wall[1], wall[2], wall[3]), dx, dy);
        }
        if (occluded)
            return 1;
    }
    return 0;
}

HD float light_at(const SceneryParams& s, int layout, float x, float y) {
    float sum = AMBIENT;
    int first_wall = s.wall_starts[layout], n_walls = s.wall_starts[layout + 1] - first_wall;
    const float* walls = s.walls + 4 * (long long)first_wall;
    for (int l = s.light_starts[layout]; l < s.light_starts[layout + 1]; l++) {
        const float* light = s.lights + 3 * l;
        float dx = x - light[0], dy = y - light[1];
        if (!is_occluded(walls, n_walls, light, dx, dy))
            sum += irradiance(light[2], dx, dy);
    }
    return minf(sum, 1.f);
}
