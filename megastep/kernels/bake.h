// The light on static texels.
#pragma once
#include "light.h"
#include "params.h"

HD void bake_texel(const BakeParams& p, int texel) {
    const SceneryParams& s = p.scenery;
    int wall = p.texel_wall[texel];
    int first = s.texel_starts[wall], width = s.texel_starts[wall + 1] - first;
    float x, y;
    texel_centre(s.walls + 4 * (long long)wall, texel - first, width, x, y);
    s.texels[4 * (long long)texel + 3] = light_at(s, p.wall_layout[wall], x, y);
}

EACH(bake, BakeParams, p.n_texels, p.scenery.n_threads, bake_texel(p, i))
