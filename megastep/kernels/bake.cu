// One thread per static texel: ambient light plus every light of its layout that no wall occludes.
#include "light.h"
#include "params.h"

DEVICE int is_occluded(const SceneryParams& s, int layout, const float* light, float dx, float dy) {
    int occluded = 0;
    for (int j = s.wall_starts[layout]; j < s.wall_starts[layout + 1] && !occluded; j++) {
        float4 wall = ((const float4*)s.walls)[j];
        Occluder occluder = occluder_of(light[0], light[1], wall.x, wall.y, wall.z, wall.w);
        occluded = occludes(occluder, dx, dy);
    }
    return occluded;
}

KERNEL bake(BakeParams p) {
    wait_for_previous();
    const SceneryParams& s = p.scenery;
    int texel = blockIdx.x * blockDim.x + threadIdx.x;
    if (texel >= p.n_texels)
        return;
    int wall = p.texel_wall[texel], layout = p.wall_layout[wall];
    int first = s.texel_starts[wall], width = s.texel_starts[wall + 1] - first;
    float x, y, sum = AMBIENT;
    texel_centre(s.walls + 4 * (long long)wall, texel - first, width, x, y);
    for (int l = s.light_starts[layout]; l < s.light_starts[layout + 1]; l++) {
        const float* light = s.lights + 3 * l;
        float dx = x - light[0], dy = y - light[1];
        if (!is_occluded(s, layout, light, dx, dy))
            sum += irradiance(light[2], dx, dy);
    }
    s.texels[4 * (long long)texel + 3] = minf(sum, 1.f);
}
