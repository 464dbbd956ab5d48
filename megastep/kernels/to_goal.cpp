// A loop over agents.
#include "to_goal.h"

KERNEL to_goal(const ToGoalParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++)
        find_goal(p, agent);
}
