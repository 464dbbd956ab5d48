// A loop over agents.
#include "seek.h"

KERNEL seek(const SeekParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++)
        seek_goal(p, agent);
}
