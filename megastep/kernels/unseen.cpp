// A loop over agents.
#include "unseen.h"

KERNEL unseen(const UnseenParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++) {
        int* bins = p.counts + agent * (long long)BINS;
        for (int i = 0; i < BINS; i++)
            bins[i] = 0;
        count_unseen(p, agent, 0, 1, bins);
    }
}
