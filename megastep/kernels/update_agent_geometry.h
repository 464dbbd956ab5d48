// Positions of an agent's lines and texels.
#pragma once
#include "light.h"
#include "params.h"

HD void update_line(const SceneryParams& s, const Pose& pose, int agent, int m) {
    Float4 line = line_at(LOAD((const Float4*)s.model + m), 1.f, pose);
    ((Float4*)s.agent_lines)[agent * (long long)s.n_model + m] = line;
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
