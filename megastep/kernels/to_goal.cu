// One thread per agent.
#include "to_goal.h"

KERNEL to_goal(ToGoalParams p) {
    int agent = blockIdx.x * blockDim.x + threadIdx.x;
    if (agent < p.scenery.n_envs * p.scenery.n_agents)
        find_goal(p, agent);
}
