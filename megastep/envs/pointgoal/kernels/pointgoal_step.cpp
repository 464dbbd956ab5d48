// A loop over agents.
#include "pointgoal_step.h"

KERNEL pointgoal_step(const PointgoalStepParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++)
        pointgoal_agent(p, agent);
}
