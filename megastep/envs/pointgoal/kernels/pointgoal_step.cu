// One thread per agent.
#include "pointgoal_step.h"

KERNEL pointgoal_step(PointgoalStepParams p) {
    wait_for_previous();
    int agent = blockIdx.x * blockDim.x + threadIdx.x;
    if (agent < p.scenery.n_envs * p.scenery.n_agents)
        pointgoal_agent(p, agent);
}
