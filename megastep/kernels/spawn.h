// Puts agents at random points of their environment's layout, out of the others' sight if so
// wanted.
#pragma once
#include "errors.h"
#include "params.h"
#include "philox.h"
#include "sight.h"

// Of agent a's own points, from number `first` on, the first that nobody who stands has in sight:
// the others that do not respawn, and those that have. If there is none, the one furthest from
// whoever stands nearest to it.
template <class Crew>
HD int hidden_point(const SpawnParams& p, const Crew& crew, int env, int a, int layout, int first) {
    int n_agents = p.scenery.n_agents, n_own = p.n_points / n_agents, furthest = first;
    const float* points = p.points + 2 * ((long long)layout * p.n_points + a * n_own);
    Walls walls = walls_of(p.scenery, layout);
    float furthest2 = -1.f;
    for (int k = 0; k < n_own; k++) {
        int point = (first + k) % n_own, seen = 0;
        float x = points[2 * point], y = points[2 * point + 1], nearest2 = INF_VALUE;
        for (int b = 0; b < n_agents; b++) {
            int other = env * n_agents + b;
            if (b == a || (b > a && p.mask[other]))
                continue;
            float from_x = p.positions[2 * other], from_y = p.positions[2 * other + 1];
            float dx = x - from_x, dy = y - from_y;
            nearest2 = minf(nearest2, dx * dx + dy * dy);
            seen = seen || in_sight(p.scenery, crew, walls, from_x, from_y, dx, dy);
        }
        if (!seen)
            return point;
        if (nearest2 > furthest2) {
            furthest2 = nearest2;
            furthest = point;
        }
    }
    return furthest;
}

HD void place(const SpawnParams& p, int i, const float* at, float angle) {
    p.counts[i]++;
    p.positions[2 * i] = at[0];
    p.positions[2 * i + 1] = at[1];
    p.angles[i] = angle;
    p.velocity[2 * i] = 0.f;
    p.velocity[2 * i + 1] = 0.f;
    p.angvelocity[i] = 0.f;
}

// Each agent that respawns goes to a point of its own share of the layout's points, at rest,
// looking anywhere; if `hidden`, out of the others' sight where it can. An environment all of whose
// agents respawn may move to another layout first.
template <int hidden, class Crew>
HD void spawn_env(const SpawnParams& p, const Crew& crew, int env) {
    const SceneryParams& s = p.scenery;
    int n_agents = s.n_agents, n_own = p.n_points / n_agents, all = 1, any = 0, layout = 0;
    for (int i = env * n_agents; i < (env + 1) * n_agents; i++) {
        all &= p.mask[i] != 0;
        any |= p.mask[i] != 0;
    }
    if (!any)
        return;
    int moves = all && p.resample;
    if (!moves)
        layout = layout_of(s, env, p.error_flag);
    for (int a = 0; a < n_agents; a++) {
        int i = env * n_agents + a;
        if (!p.mask[i])
            continue;
        Philox bits = philox((unsigned int)i, (unsigned int)p.counts[i], p.key0, p.key1);
        if (a == 0 && moves)
            layout = (int)(unit_float(bits.c) * (float)s.n_layouts);
        int point = (int)(unit_float(bits.a) * (float)n_own);
        if (hidden)
            point = hidden_point(p, crew, env, a, layout, point);
        sync(crew);  // until all have read what is written now
        if (crew.rank == 0) {
            if (p.chosen)
                p.chosen[i] = a * n_own + point;
            place(p, i, p.points + 2 * ((long long)layout * p.n_points + a * n_own + point),
                  360.f * unit_float(bits.b) - 180.f);
        }
        sync(crew);
    }
    if (moves && crew.rank == 0)
        s.layout[env] = layout;
}
