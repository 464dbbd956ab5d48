// One block per agent, over the walls of its layout.
#include "unseen.h"

KERNEL BOUNDS(20) unseen(UnseenParams p) {
    __shared__ int bins[BINS];
    const SceneryParams& s = p.scenery;
    int agent = blockIdx.x;
    for (int i = threadIdx.x; i < BINS; i += BLOCK)
        bins[i] = 0;
    __syncthreads();
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    if (threadIdx.x == 0)
        flag_nonfinite(p.error_flag, env, x, y, angle);
    Pose pose = pose_at(x, y, angle);
    Walls walls = walls_of(s, layout);
    int first_texel = s.texel_starts[walls.first_wall];
    const unsigned int* seen = p.seen + agent * (long long)p.n_words;
    const unsigned int* visible = p.visible + layout * (long long)p.n_words;
    for (int wall = walls.first_wall + threadIdx.x; wall < walls.end_wall; wall += BLOCK)
        count_unseen(p, pose, seen, visible, first_texel, wall, bins);
    __syncthreads();
    for (int i = threadIdx.x; i < BINS; i += BLOCK)
        p.counts[agent * (long long)BINS + i] = bins[i];
}
