// One warp per agent, over the walls of its layout.
#include "unseen.h"

KERNEL unseen(UnseenParams p) {
    __shared__ int shared[BLOCK / WARP][BINS];
    const SceneryParams& s = p.scenery;
    int agent = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, warp_lane = threadIdx.x % WARP;
    if (agent >= s.n_envs * s.n_agents)
        return;
    int* bins = shared[threadIdx.x / WARP];
    for (int i = warp_lane; i < BINS; i += WARP)
        bins[i] = 0;
    __syncwarp();
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    if (warp_lane == 0)
        flag_nonfinite(p.error_flag, env, x, y, angle);
    Pose pose = pose_at(x, y, angle);
    Walls walls = walls_of(s, layout);
    int first_texel = s.texel_starts[walls.first_wall];
    const unsigned int* seen = p.seen + agent * (long long)p.n_words;
    const unsigned int* visible = p.visible + layout * (long long)p.n_words;
    for (int wall = walls.first_wall + warp_lane; wall < walls.end_wall; wall += WARP)
        count_unseen(p, pose, seen, visible, first_texel, wall, bins);
    __syncwarp();
    for (int i = warp_lane; i < BINS; i += WARP)
        p.counts[agent * (long long)BINS + i] = bins[i];
}
