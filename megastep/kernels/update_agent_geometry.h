// Positions of an agent's lines and texels.
#pragma once
#include "light.h"
#include "params.h"

// Moves line m of the model to the agent's pose. Written with sums alone: GCC 12, when it
// vectorises a sum beside a difference, fuses them with the products in spite of -ffp-contract=off.
HD void update_line(const SceneryParams& s, const Pose& pose, int agent, int m) {
    float minus_sine = -pose.sine;
    float* line = s.agent_lines + 4 * (agent * (long long)s.n_model + m);
    for (int end = 0; end < 2; end++) {
        float x = s.model[4 * m + 2 * end];
        float y = s.model[4 * m + 2 * end + 1];
        line[2 * end] = pose.x + (pose.cosine * x + minus_sine * y);
        line[2 * end + 1] = pose.y + (pose.sine * x + pose.cosine * y);
    }
}

// The centre of texel `texel` of the environment's K, which belongs to agent a. Call update_line
// first.
HD void agent_texel_centre(const SceneryParams& s, int env, int a, int texel, float& x, float& y) {
    int l = a * s.n_model;
    while (texel >= s.model_texels[l + 1])
        l++;
    int first = s.model_texels[l];
    const float* line = s.agent_lines + 4 * (env * (long long)(s.n_agents * s.n_model) + l);
    texel_centre(line, texel - first, s.model_texels[l + 1] - first, x, y);
}
