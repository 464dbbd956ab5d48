// Where an agent's lines and texels lie.
#pragma once
#include "common.h"
#include "light.h"
#include "params.h"

// Carries line m of the model to where the agent stands. Sums alone: GCC 12 fuses a sum and a
// difference side by side as it vectorises, whatever -ffp-contract says.
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

// The centre of a texel of agent a, one of the K of its environment, once its lines are updated.
HD void agent_texel_centre(const SceneryParams& s, int env, int a, int texel, float& x, float& y) {
    int l = a * s.n_model;
    while (texel >= s.model_texels[l + 1])
        l++;
    int first = s.model_texels[l];
    const float* line = s.agent_lines + 4 * (env * (long long)(s.n_agents * s.n_model) + l);
    texel_centre(line, texel - first, s.model_texels[l + 1] - first, x, y);
}
