// One thread per static texel: ambient light, and every light of its layout that no wall occludes.
#include "light.h"

DEVICE int is_hidden(const SceneryParams& s, int layout, const float* light, float dx, float dy) {
    int hidden = 0;
    for (int j = s.wall_starts[layout]; j < s.wall_starts[layout + 1] && !hidden; j++) {
        float4 wall = ((const float4*)s.walls)[j];
        Occluder occluder = occluder_of(light[0], light[1], wall.x, wall.y, wall.z, wall.w);
        hidden = occludes(occluder, dx, dy);
    }
    return hidden;
}

KERNEL bake(BakeParams p) {
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
        if (!is_hidden(s, layout, light, dx, dy))
            sum += irradiance(light[2], dx, dy);
    }
    s.texels[4 * (long long)texel + 3] = minf(sum, 1.f);
}
