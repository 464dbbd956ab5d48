// The light at a point, on the CPU. Walls are tested 64 at a time, in loops that compilers
// vectorise.
#pragma once
#include "common/scenery.h"
#include "light.h"

// Returns 1 if any of n walls occludes the light from a point at (dx, dy) from it.
static int is_occluded(const float* walls, int n, const float* light, float dx, float dy) {
    for (int start = 0; start < n; start += 64) {
        int end = mini(start + 64, n);
        int occluded = 0;
#pragma omp simd reduction(| : occluded)
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

static float light_at(const SceneryParams& s, int layout, float x, float y) {
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
