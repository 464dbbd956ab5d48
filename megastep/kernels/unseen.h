// Counts of the visible texels that an agent has not seen yet, in 16 sectors of bearing relative to
// the agent's heading and 3 bands of distance.
#pragma once
#include "common/bins.h"
#include "common/scenery.h"
#include "params.h"

// Adds the unseen texels of a wall. `first_texel` is the first texel of the wall's layout. Texels
// that share a word of bits, at most 1.6 m of a wall, are all counted at their midpoint.
HD void count_wall(const UnseenParams& p, const Pose& pose, const unsigned int* seen,
                   const unsigned int* visible, int first_texel, int wall, int* bins) {
    int first = p.scenery.texel_starts[wall] - first_texel;
    int end = p.scenery.texel_starts[wall + 1] - first_texel;
    Float4 line = LOAD((const Float4*)p.scenery.walls + wall);
    for (int word = first >> 5; word <= (end - 1) >> 5; word++) {
        int from = maxi(first, 32 * word), to = mini(end, 32 * word + 32);
        unsigned int bits = visible[word] & ~seen[word] & (~0u << (from & 31));
        bits &= ~0u >> (32 * word + 32 - to);
        if (!bits)
            continue;
        float middle = (0.5f * (float)(from + to) - (float)first) / (float)(end - first);
        float x = mix(line.x, line.z, middle), y = mix(line.y, line.w, middle);
        ADD(bins + bin_of(pose, x, y), COUNT_BITS(bits));
    }
}

// Adds the unseen texels of every `n_threads`-th wall of an agent's layout, starting at wall
// `rank`.
HD void count_unseen(const UnseenParams& p, int agent, int rank, int n_threads, int* bins) {
    const SceneryParams& s = p.scenery;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    if (rank == 0)
        flag_nonfinite(p.error_flag, env, x, y, angle);
    Pose pose = pose_at(x, y, angle);
    Walls walls = walls_of(s, layout);
    int first_texel = s.texel_starts[walls.first_wall];
    const unsigned int* seen = p.seen + agent * (long long)p.n_words;
    const unsigned int* visible = p.visible + layout * (long long)p.n_words;
    for (int wall = walls.first_wall + rank; wall < walls.end_wall; wall += n_threads)
        count_wall(p, pose, seen, visible, first_texel, wall, bins);
}
