// Agents that seek a goal: where it lies, straight and by the shortest way; rewards, and when
// episodes begin and end. An agent that begins an episode draws a goal first.
#pragma once
#include "errors.h"
#include "philox.h"

// Rows of a journey: where the agent was a step ago, and how far from its goal by the shortest way;
// how far it was at the start, by the field and in truth; what it walked and ran into since then.
constexpr int AT_X = 0, AT_Y = 1, DISTANCE = 2, FIRST = 3, SHORTEST = 4, WALKED = 5, COLLISIONS = 6;
constexpr int TOLD = 4;  // numbers that a critic is told

struct Field {
    const unsigned short* cells;  // fp16
    int height, width;
    float x, y;  // the centre of the first cell
};

struct Reading {
    float distance, along_x, along_y;  // and its slopes, per metre
};

// A field between the centres of four cells. A cell from which nothing leads to the goal holds
// infinity: the others speak for it. Where none of the four holds a number, the distance is
// infinite.
HD Reading read_field(const Field& f, float per_cell, float x, float y) {
    float u = (x - f.x) * per_cell, v = (y - f.y) * per_cell;
    int column = (int)clamp(u, 0.f, (float)(f.width - 2));
    int row = (int)clamp(v, 0.f, (float)(f.height - 2));
    float right = clamp(u - (float)column, 0.f, 1.f), up = clamp(v - (float)row, 0.f, 1.f);
    float weight[4] = {(1.f - right) * (1.f - up), right * (1.f - up), (1.f - right) * up,
                       right * up};
    float value[4], total = 0.f, weighted = 0.f, sum = 0.f;
    int n_known = 0;
    for (int i = 0; i < 4; i++) {
        value[i] = HALF_VALUE(f.cells[(long long)(row + i / 2) * f.width + column + i % 2]);
        if (is_finite(value[i])) {
            weighted += weight[i] * value[i];
            total += weight[i];
            sum += value[i];
            n_known++;
        }
    }
    if (!n_known)
        return {INF_VALUE, 0.f, 0.f};
    float found = total > 0.f ? weighted / total : sum / (float)n_known;
    for (int i = 0; i < 4; i++)
        value[i] = is_finite(value[i]) ? value[i] : found;
    return {found, mix(value[1] - value[0], value[3] - value[2], up) * per_cell,
            mix(value[2] - value[0], value[3] - value[1], right) * per_cell};
}

// A number below n, or 0 with a flag.
HD int below(int number, int n, int* error_flag, int env) {
    if ((unsigned int)number < (unsigned int)n)
        return number;
    flag_error(error_flag, env, BAD_GOAL);
    return 0;
}

// A goal within range of the spawn point. Returns the length of the shortest way there.
HD float draw_goal(const SeekParams& p, int agent, int env, int layout) {
    Philox bits = philox((unsigned int)agent, (unsigned int)p.draws[agent]++, p.key0, p.key1);
    int spawn = below(p.spawned[agent], p.n_spawns, p.error_flag, env);
    long long row = (long long)layout * p.n_spawns + spawn;
    int place = (int)(unit_float(bits.a) * (float)p.n_in_range[row]);
    int goal = p.in_range[row * p.n_goals + place];
    p.goals[agent] = goal;
    return p.lengths[row * p.n_goals + goal];
}

HD float share(float part, float whole) { return part / maxf(whole, 1e-3f); }

// What an episode amounts to where it ends: success, success weighted by path length (Anderson et
// al. 2018), the same of the part of the way that was made (Datta et al. 2020), collisions.
HD void count(const SeekParams& p, int agent, int n, int ends, int there) {
    const float* journey = p.journey + agent;
    long long rows = n;
    float shortest = journey[SHORTEST * rows];
    float efficiency = share(shortest, maxf(shortest, journey[WALKED * rows]));
    float made = clamp(1.f - share(journey[DISTANCE * rows], journey[FIRST * rows]), 0.f, 1.f);
    p.metrics[agent] = ends && there ? 1.f : 0.f;
    p.metrics[rows + agent] = ends && there ? efficiency : 0.f;
    p.metrics[2 * rows + agent] = ends ? (there ? 1.f : made) * efficiency : 0.f;
    p.metrics[3 * rows + agent] = ends ? journey[COLLISIONS * rows] : 0.f;
}

HD void seek_goal(const SeekParams& p, int agent) {
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    int n = s.n_envs * s.n_agents, reset = p.ended[agent];
    long long rows = n;
    float* journey = p.journey + agent;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1];
    flag_nonfinite(p.error_flag, env, x, y, p.angles[agent]);
    Pose pose = pose_at(x, y, p.angles[agent]);
    if (reset)
        journey[SHORTEST * rows] = draw_goal(p, agent, env, layout);

    int goal = below(p.goals[agent], p.n_goals, p.error_flag, env);
    const float* at = p.points + 2 * ((long long)layout * p.n_goals + goal);
    float dx = at[0] - x, dy = at[1] - y, straight = SQRT(dx * dx + dy * dy);
    float ahead = pose.cosine * dx + pose.sine * dy, left = pose.cosine * dy - pose.sine * dx;
    unsigned short* bearing = p.bearing + 3 * (long long)agent;
    bearing[0] = HALF_BITS(straight * 0.1f);
    bearing[1] = HALF_BITS(straight > 0.f ? ahead / straight : 1.f);
    bearing[2] = HALF_BITS(straight > 0.f ? left / straight : 0.f);

    int height = p.shapes[2 * layout], width = p.shapes[2 * layout + 1];
    Field field = {p.fields + p.starts[layout] + (long long)goal * height * width, height, width,
                   p.origins[2 * layout], p.origins[2 * layout + 1]};
    Reading way = read_field(field, p.per_cell, x, y);
    float before = journey[DISTANCE * rows];
    float distance = is_finite(way.distance) ? way.distance : before;
    float moved_x = x - journey[AT_X * rows], moved_y = y - journey[AT_Y * rows];
    float moved = SQRT(moved_x * moved_x + moved_y * moved_y);
    float hit = p.free && p.free[agent] < 1.f ? 1.f : 0.f;
    journey[AT_X * rows] = x;
    journey[AT_Y * rows] = y;
    journey[DISTANCE * rows] = distance;
    journey[FIRST * rows] = reset ? distance : journey[FIRST * rows];
    journey[WALKED * rows] = reset ? 0.f : journey[WALKED * rows] + moved;
    journey[COLLISIONS * rows] = reset ? 0.f : journey[COLLISIONS * rows] + hit;

    int age = reset ? 0 : p.ages[agent] + 1, there = straight <= p.reach;
    int ends = !reset && (there || age >= p.limit);
    p.reward[agent] = reset ? 0.f : before - distance + (there ? p.bonus : 0.f) - p.cost;
    p.reset[agent] = (unsigned char)reset;
    p.terminal[agent] = (unsigned char)(ends && there);
    p.truncated[agent] = (unsigned char)(ends && !there);
    p.ended[agent] = (unsigned char)ends;
    p.ages[agent] = age;
    count(p, agent, n, ends, there);
    if (p.told) {
        float* told = p.told + TOLD * (long long)agent;
        told[0] = distance * 0.1f;
        told[1] = -(pose.cosine * way.along_x + pose.sine * way.along_y);
        told[2] = -(pose.cosine * way.along_y - pose.sine * way.along_x);
        told[3] = (float)(p.limit - age) / (float)p.limit;
    }
}
