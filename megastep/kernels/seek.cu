// One thread per agent.
#include "seek.h"

KERNEL seek(SeekParams p) {
    int agent = blockIdx.x * blockDim.x + threadIdx.x;
    if (agent < p.scenery.n_envs * p.scenery.n_agents)
        seek_goal(p, agent);
}
