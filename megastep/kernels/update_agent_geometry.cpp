// A loop over agents: moves their models to their poses and, if `lit`, lights their texels.
#include "update_agent_geometry.h"

static void light_agent(const UpdateAgentGeometryParams& p, int env, int a) {
    const SceneryParams& s = p.scenery;
    int layout = layout_of(s, env, p.error_flag);
    float* light = s.agent_light + env * (long long)s.n_agent_texels;
    int end = s.model_texels[(a + 1) * s.n_model];
    for (int texel = s.model_texels[a * s.n_model]; texel < end; texel++) {
        float x, y;
        agent_texel_centre(s, env, a, texel, x, y);
        light[texel] = light_at(s, layout, x, y);
    }
}

KERNEL update_agent_geometry(const UpdateAgentGeometryParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++) {
        float x = p.positions[2 * agent], y = p.positions[2 * agent + 1];
        Pose pose = pose_at(x, y, p.angles[agent]);
        for (int m = 0; m < s.n_model; m++)
            update_line(s, pose, agent, m);
        if (p.lit)
            light_agent(p, agent / s.n_agents, agent % s.n_agents);
    }
}
