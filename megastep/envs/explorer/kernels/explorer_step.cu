// With a privileged observation one warp per agent, which counts what is unseen. Otherwise one
// thread per agent; a warp then counts only for those whose episode ends, one after the other.
#include "explorer_step.h"

constexpr int BATCH = 4;  // runs that a warp lane loads at once

// The texels of a layout that an agent has not seen yet. If `binned`, adds them to bins in shared
// memory, too.
template <int binned>
DEVICE int count_left(const ExplorerStepParams& p, int agent, const Range& runs, const Pose& pose,
                      int warp_lane, int* bins) {
    const unsigned int* seen = seen_by(p, agent);
    asm("" : "+l"(seen));  // else its offset is computed anew for each run
    unsigned int last = p.n_words - 1;
    int n_left = 0;
#pragma unroll 1
    for (int first = runs.first + warp_lane; first < runs.end; first += BATCH * WARP) {
        Run run[BATCH];
        int counts[BATCH];
        for (int k = 0; k < BATCH; k++) {
            run[k] = {0.f, 0.f, 0u, 0u};
            if (first + k * WARP < runs.end)
                run[k] = LOAD((const Run*)p.runs + first + k * WARP);
        }
        for (int k = 0; k < BATCH; k++) {
            counts[k] = unseen_of(run[k].word, run[k].bits, seen, last);
            n_left += counts[k];
        }
        for (int k = 0; binned && k < BATCH; k++)
            if (counts[k])
                ADD(bins + bin_of(pose, run[k].x, run[k].y), counts[k]);
    }
    return __reduce_add_sync(FULL_WARP, n_left);
}

// All warp lanes read an agent's episode, and one writes it.
DEVICE void step_privileged(const ExplorerStepParams& p, int agent, int warp_lane, int* bins) {
    if (!takes_part(p, agent))
        return;
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, index = s.layout[env];  // read beside all that follows
#pragma unroll 1
    for (int k = WARP * warp_lane; k < p.n_words; k += WARP * WARP)
        PREFETCH(seen_by(p, agent) + k);
    Episode episode = next(p, read_episode(p, agent));
    Pose pose = pose_of(p, agent, env);
    int layout = checked(index, s.n_layouts, p.error_flag, env, BAD_LAYOUT);
    for (int k = warp_lane; k < BINS; k += WARP)
        bins[k] = 0;
    __syncwarp();
    int n_left = count_left<1>(p, agent, runs_of(p, layout), pose, warp_lane, bins);
    __syncwarp();
    for (int k = warp_lane; k < BINS; k += WARP)
        p.unseen[BINS * (long long)agent + k] = unseen_number(p, bins[k]);
    if (warp_lane < N_EPISODE)
        p.episode[N_EPISODE * (long long)agent + warp_lane] =
            episode_number(p, episode, n_left, warp_lane);
    if (warp_lane)
        return;
    write_episode(p, episode, agent);
    if (p.metrics)
        write_coverage(p, episode, agent, layout, n_left);
}

DEVICE void step_plain(const ExplorerStepParams& p, int agent, int warp_lane) {
    const SceneryParams& s = p.scenery;
    int exists = agent < s.n_envs * s.n_agents && takes_part(p, agent);
    Episode episode = {0, 0, 0, 1};
    if (exists) {
        episode = next(p, read_episode(p, agent));
        write_episode(p, episode, agent);
        if (p.metrics)
            p.metrics[agent] = 0.f;
    }
    if (!p.metrics)
        return;
    unsigned int over = __ballot_sync(FULL_WARP, exists && is_over(episode));
    for (; over; over &= over - 1) {
        int owner = __ffs(over) - 1, other = agent - warp_lane + owner;
        int layout = layout_of(s, other / s.n_agents, p.error_flag);
        Range runs = runs_of(p, layout);
        int n_left = count_left<0>(p, other, runs, {0.f, 0.f, 0.f, 1.f}, warp_lane, 0);
        if (warp_lane == owner)
            write_coverage(p, episode, agent, layout, n_left);
    }
}

KERNEL BOUNDS(20) explorer_step(ExplorerStepParams p) {
    wait_for_previous();
    __shared__ int bins[BLOCK / WARP * BINS];
    int thread = blockIdx.x * blockDim.x + threadIdx.x, warp_lane = threadIdx.x % WARP;
    if (!p.unseen)
        step_plain(p, thread, warp_lane);
    else if (thread / WARP < p.scenery.n_envs * p.scenery.n_agents)
        step_privileged(p, thread / WARP, warp_lane, bins + BINS * (threadIdx.x / WARP));
}
