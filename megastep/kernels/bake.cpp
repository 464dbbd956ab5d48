// A loop over static texels.
#include "light_cpu.h"
#include "params.h"

KERNEL bake(const BakeParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(dynamic, 256) num_threads(s.n_threads)
    for (int texel = 0; texel < p.n_texels; texel++) {
        int wall = p.texel_wall[texel];
        int first = s.texel_starts[wall], width = s.texel_starts[wall + 1] - first;
        float x, y;
        texel_centre(s.walls + 4 * (long long)wall, texel - first, width, x, y);
        s.texels[4 * (long long)texel + 3] = light_at(s, p.wall_layout[wall], x, y);
    }
}
