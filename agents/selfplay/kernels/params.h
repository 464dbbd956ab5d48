// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

// M environments of A agents.
struct CountPairsParams {
    const float* reward;             // (M, A), of this step, as the next two
    const unsigned char* terminal;   // (M, A)
    const unsigned char* truncated;  // (M, A)
    const unsigned char* own;        // (M, A), the agents that are scored
    float* returns;                  // (M, A), of the episodes in progress, updated
    float* pairs;                    // (2, M), won and decided, updated
    int n_envs;                      // M
    int n_agents;                    // A
};
