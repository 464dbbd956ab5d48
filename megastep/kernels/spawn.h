// Puts agents at random points of their environment's layout.
#pragma once
#include "errors.h"
#include "params.h"
#include "philox.h"

// Each agent that respawns goes to a point of its own share of the layout's points, at rest,
// looking anywhere. An environment all of whose agents respawn may move to another layout first.
HD void spawn_env(const SpawnParams& p, int env) {
    const SceneryParams& s = p.scenery;
    int n_agents = s.n_agents;
    int all = 1;
    for (int a = 0; a < n_agents; a++)
        all &= p.mask[env * n_agents + a] != 0;
    for (int a = 0; a < n_agents; a++) {
        int i = env * n_agents + a;
        if (!p.mask[i])
            continue;
        int n_own = p.n_points / n_agents;
        unsigned int draw = (unsigned int)p.counts[i]++;
        Philox bits = philox((unsigned int)i, draw, p.key0, p.key1);
        if (a == 0 && all && p.resample)
            s.layout[env] = (int)(unit_float(bits.c) * (float)s.n_layouts);
        int point = a * n_own + (int)(unit_float(bits.a) * (float)n_own);
        const float* at =
            p.points + 2 * ((long long)layout_of(s, env, p.error_flag) * p.n_points + point);
        p.positions[2 * i] = at[0];
        p.positions[2 * i + 1] = at[1];
        p.angles[i] = 360.f * unit_float(bits.b) - 180.f;
        p.velocity[2 * i] = 0.f;
        p.velocity[2 * i + 1] = 0.f;
        p.angvelocity[i] = 0.f;
    }
}
