// A loop over agents.
#include "unseen.h"

KERNEL unseen(const UnseenParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++) {
        int* bins = p.counts + agent * (long long)BINS;
        for (int i = 0; i < BINS; i++)
            bins[i] = 0;
        float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
        int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
        flag_nonfinite(p.error_flag, env, x, y, angle);
        Pose pose = pose_at(x, y, angle);
        Walls walls = walls_of(s, layout);
        int first_texel = s.texel_starts[walls.first_wall];
        const unsigned int* seen = p.seen + agent * (long long)p.n_words;
        const unsigned int* visible = p.visible + layout * (long long)p.n_words;
        for (int wall = walls.first_wall; wall < walls.end_wall; wall++)
            count_unseen(p, pose, seen, visible, first_texel, wall, bins);
    }
}
