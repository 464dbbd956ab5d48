// One warp per 32 agents. Few of them are asked for at a time, so the warp takes those one after
// the other, 32 words at once.
#include "coverage.h"

KERNEL coverage(CoverageParams p) {
    const SceneryParams& s = p.scenery;
    int own = blockIdx.x * blockDim.x + threadIdx.x, warp_lane = threadIdx.x % WARP;
    int exists = own < s.n_envs * s.n_agents;
    unsigned int asked = __ballot_sync(FULL_WARP, exists && p.mask[own]);
    float share = 0.f;
    for (; asked; asked &= asked - 1) {
        int chosen = __ffs(asked) - 1, agent = own - warp_lane + chosen;
        int layout = layout_of(s, agent / s.n_agents, p.error_flag);
        const unsigned int* seen = p.seen + agent * (long long)p.n_words;
        const unsigned int* visible = p.visible + layout * (long long)p.n_words;
        int n_seen = 0, n_visible = 0;
        for (int i = warp_lane; i < p.n_words; i += WARP)
            count_covered(seen[i], visible[i], n_seen, n_visible);
        n_seen = __reduce_add_sync(FULL_WARP, n_seen);
        n_visible = __reduce_add_sync(FULL_WARP, n_visible);
        if (warp_lane == chosen)
            share = share_of(n_seen, n_visible);
    }
    if (exists)
        p.coverage[own] = share;
}
