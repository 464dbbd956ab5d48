// Respawns agents at random points of their environment's layout, optionally where no other agent
// sees them.
#pragma once
#include "common/line_of_sight.h"
#include "common/philox.h"
#include "params.h"

// The first of agent a's points, counted from `first`, that is on no obstacle and, if `hidden`,
// that no placed agent can see. Placed are agents that do not respawn and those that already have.
// If every point is visible, the one that is furthest from its nearest placed agent; if there is
// none, the first.
template <int hidden, int with_objects, class Group>
HD int point_of(const SpawnParams& p, const Group& group, int env, int a, int layout, int first) {
    int n_agents = p.scenery.n_agents, n_per_agent = p.n_points / n_agents, furthest = first;
    const float* points = p.points + 2 * ((long long)layout * p.n_points + a * n_per_agent);
    Walls walls = walls_of(p.scenery, layout);
    float furthest2 = -1.f;
    for (int k = 0; k < n_per_agent; k++) {
        int point = (first + k) % n_per_agent, seen = 0;
        float x = points[2 * point], y = points[2 * point + 1], nearest2 = INF_VALUE;
        if (with_objects && !is_clear(p.objects, env, x, y, p.scenery.radius))
            continue;
        if (!hidden)
            return point;
        for (int b = 0; b < n_agents; b++) {
            int other = env * n_agents + b;
            if (b == a || (b > a && p.mask[other]))
                continue;
            float from_x = p.positions[2 * other], from_y = p.positions[2 * other + 1];
            float dx = x - from_x, dy = y - from_y;
            nearest2 = minf(nearest2, dx * dx + dy * dy);
            seen = seen || is_visible<with_objects>(p.scenery, p.objects, group, walls, env, from_x,
                                                    from_y, dx, dy);
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

// A layout drawn by a random number. With weights, a fraction bits / 2^32 of their sum lies in the
// interval of one layout: the first whose cumulative weight is above it.
HD int drawn_layout(const SpawnParams& p, unsigned int bits) {
    int n_layouts = p.scenery.n_layouts, low = 0, high = n_layouts - 1;
    if (!p.cumulative)
        return (int)(unit_float(bits) * (float)n_layouts);
    unsigned long long total = (unsigned int)p.cumulative[high];
    int at = (int)(bits * total >> 32);
    while (low < high) {
        int middle = (low + high) / 2;
        if (p.cumulative[middle] > at)
            high = middle;
        else
            low = middle + 1;
    }
    return low;
}

HD void place(const SpawnParams& p, int i, const float* at, float angle) {
    p.counts[i] = (int)((unsigned int)p.counts[i] + 1u);  // wraps, as Philox's counter does
    p.positions[2 * i] = at[0];
    p.positions[2 * i + 1] = at[1];
    p.angles[i] = angle;
    p.velocity[2 * i] = 0.f;
    p.velocity[2 * i + 1] = 0.f;
    p.angvelocity[i] = 0.f;
}

// Has agent a drop what it carries, where it is, and let go of what it holds.
template <class Group>
HD void drop_all(const ObjectsParams& o, const Group& group, int env, int a) {
    for (int i = env * o.n_objects + group.rank; i < (env + 1) * o.n_objects; i += Group::SIZE)
        if (objects_of(o)[i].carrier == a)
            objects_of(o)[i].carrier = -1;
    for (int i = env * o.n_bodies + group.rank; i < (env + 1) * o.n_bodies; i += Group::SIZE)
        if (bodies_of(o)[i].holder == a)
            bodies_of(o)[i].holder = -1;
}

// Respawns the masked agents of an environment: at rest, with a random heading, at a random point
// of the agent's own share of the layout's points; if `hidden`, at one that no other agent sees, if
// there is one. An environment whose agents all respawn may move to another layout first. They drop
// what they carry, and respawn on no obstacle, unless it is of another layout.
template <int hidden, int with_objects, class Group>
HD void spawn_env(const SpawnParams& p, const Group& group, int env) {
    const SceneryParams& s = p.scenery;
    int n_agents = s.n_agents, n_per_agent = p.n_points / n_agents, all = 1, any = 0, layout = 0;
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
            layout = drawn_layout(p, bits.c);
        int point = (int)(unit_float(bits.a) * (float)n_per_agent);
        if (hidden || (with_objects && !moves))
            point = point_of<hidden, with_objects>(p, group, env, a, layout, point);
        sync(group);  // all threads have read what is written now
        if (with_objects)
            drop_all(p.objects, group, env, a);
        if (group.rank == 0) {
            if (with_objects && p.objects.elevated)
                p.objects.elevated[i] = 0;
            if (p.point_index)
                p.point_index[i] = a * n_per_agent + point;
            place(p, i, p.points + 2 * ((long long)layout * p.n_points + a * n_per_agent + point),
                  360.f * unit_float(bits.b) - 180.f);
        }
        sync(group);
    }
    if (moves && group.rank == 0)
        s.layout[env] = layout;
}

// The same of neighbouring environments: many have too many warps, most with nothing to do.
template <class Group>
HD void spawn_neighbours(const SpawnParams& p, const Group& group, int number) {
    int first = number * p.per_warp, end = mini(first + p.per_warp, p.scenery.n_envs);
    for (int env = first; env < end; env++)
        spawn_env<0, 1>(p, group, env);
}

// Agents, few of which respawn: a GPU has a thread per environment. Where points are to be hidden
// it has a warp, each thread of which tests one wall at a time; so it has where there are objects,
// of which each thread drops some.
EACH(spawn, SpawnParams, p.scenery.n_envs, threads_for_agents(p.scenery, 1 << 14),
     spawn_env<0, 0>(p, SingleThread{0}, i))
EACH_WARP(spawn_objects, SpawnParams, (p.scenery.n_envs + p.per_warp - 1) / p.per_warp,
          threads_for_agents(p.scenery, 1 << 14), spawn_neighbours(p, group, i))
EACH_WARP(spawn_hidden, SpawnParams, p.scenery.n_envs, p.scenery.n_threads,
          spawn_env<1, 0>(p, group, i))
EACH_WARP(spawn_hidden_objects, SpawnParams, p.scenery.n_envs, p.scenery.n_threads,
          spawn_env<1, 1>(p, group, i))
