// One warp per 32 agents. Usually few agents are masked at a time, so the warp handles these one
// after the other, 32 words at once.
#include "coverage.h"

KERNEL coverage(CoverageParams p) {
    wait_for_previous();
    const SceneryParams& s = p.scenery;
    int thread = blockIdx.x * blockDim.x + threadIdx.x, warp_lane = threadIdx.x % WARP;
    int exists = thread < s.n_envs * s.n_agents;
    unsigned int masked = __ballot_sync(FULL_WARP, exists && p.mask[thread]);
    float fraction = 0.f;
    for (; masked; masked &= masked - 1) {
        int owner = __ffs(masked) - 1, agent = thread - warp_lane + owner;
        int layout = layout_of(s, agent / s.n_agents, p.error_flag);
        const unsigned int* seen = p.seen + agent * (long long)p.n_words;
        const unsigned int* visible = p.visible + layout * (long long)p.n_words;
        int n_seen = 0, n_visible = 0;
        for (int i = warp_lane; i < p.n_words; i += WARP)
            count_covered(seen[i], visible[i], n_seen, n_visible);
        n_seen = __reduce_add_sync(FULL_WARP, n_seen);
        n_visible = __reduce_add_sync(FULL_WARP, n_visible);
        if (warp_lane == owner)
            fraction = fraction_of(n_seen, n_visible);
    }
    if (exists)
        p.coverage[thread] = fraction;
}
