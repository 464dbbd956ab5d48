// One step of PointGoal. Computes an agent's distance and bearing to its goal, rewards, and where
// episodes start and end. An agent that starts an episode draws a goal first.
#pragma once
#include "common/philox.h"
#include "common/step.h"

// Rows of `progress`, which describes an agent's episode so far.
constexpr int PREVIOUS_X = 0;  // position one step ago, in metres
constexpr int PREVIOUS_Y = 1;
constexpr int DISTANCE = 2;        // to the goal by the shortest path, from the goal's field
constexpr int START_DISTANCE = 3;  // the same at the start of the episode
constexpr int SHORTEST = 4;        // exact length of the shortest path from the start
constexpr int WALKED = 5;          // metres walked since the start
constexpr int COLLISIONS = 6;      // since the start
constexpr int PROGRESS_ROWS = 7;

constexpr int N_PRIVILEGED = 4;  // numbers that a critic sees

// N environments, A agents per environment, D layouts. Metrics: success, SPL, soft SPL, collisions.
struct PointgoalStepParams : DrawnGameParams {
    const float* free;       // (N, A) fraction of the step that was free; null: no step was taken
    const int* spawn_index;  // (N, A) spawn point of the layout, where an episode starts
    const float* points;     // (D, n_goals, 2) the goals
    const unsigned short* fields;  // fp16, per layout (n_goals, height, width): metres to the goal
    const unsigned short* last;    // (1) the last cell of all fields
    const long long* starts;       // (D) first cell of each layout's fields
    const int* shapes;             // (D, 2) height, width
    const float* origins;          // (D, 2) the centre of the first cell
    const float* lengths;          // (D, n_spawns, n_goals) of the shortest paths
    const int* in_range;       // (D, n_spawns, n_goals) goals; those that may be drawn come first
    const int* n_in_range;     // (D, n_spawns) number of goals that may be drawn
    int* goal_index;           // (N, A) in and out, as the next: the agent's goal, of its layout's
    float* progress;           // (PROGRESS_ROWS, N, A) see above
    unsigned short* goal_obs;  // (N, A, 3) fp16: distance / 10 m, cosine and sine of the bearing
    float* privileged;         // (N, A, N_PRIVILEGED) for a critic; null: none
    float per_cell;            // cells per metre
    float reach;               // metres: success within this distance of the goal
    const float* bonus;        // (), reward for success
    const float* cost;         // (), reward subtracted per step
    const float* walk_cost;    // (), reward subtracted per metre walked
    int limit;                 // steps per episode
    int n_goals;               // per layout
    int n_spawns;              // per layout
};

// Metres to a goal by the shortest path, at the centres of square cells.
struct Field {
    const unsigned short* cells;  // fp16, of all fields
    long long first, last;        // of these, this field's first, and the last of all
    int height, width;
    float x, y;  // the centre of the first cell
};

// A field's value at a point, and its gradient per metre.
struct Reading {
    float distance, gradient_x, gradient_y;
};

// Interpolates a field between the centres of four cells. A cell from which the goal cannot be
// reached holds infinity and is left out. If all four do, the distance is infinite.
HD Reading read_field(const Field& f, float per_cell, float x, float y) {
    float u = (x - f.x) * per_cell, v = (y - f.y) * per_cell;
    int column = (int)clamp(u, 0.f, (float)(f.width - 2));
    int row = (int)clamp(v, 0.f, (float)(f.height - 2));
    float right = clamp(u - (float)column, 0.f, 1.f), up = clamp(v - (float)row, 0.f, 1.f);
    float weight[4] = {(1.f - right) * (1.f - up), right * (1.f - up), (1.f - right) * up,
                       right * up};
    float value[4], total = 0.f, weighted = 0.f, sum = 0.f;
    int n_known = 0;
    long long at = f.first + (long long)row * f.width + column;
    if (f.width < 1 || at < 0 || at + f.width + 1 > f.last)
        return {INF_VALUE, 0.f, 0.f};
    for (int i = 0; i < 4; i++) {
        value[i] = HALF_VALUE(f.cells[at + (i / 2) * (long long)f.width + i % 2]);
        if (is_finite(value[i])) {
            weighted += weight[i] * value[i];
            total += weight[i];
            sum += value[i];
            n_known++;
        }
    }
    if (!n_known)
        return {INF_VALUE, 0.f, 0.f};
    float distance = total > 0.f ? weighted / total : sum / (float)n_known;
    for (int i = 0; i < 4; i++)
        value[i] = is_finite(value[i]) ? value[i] : distance;
    return {distance, mix(value[1] - value[0], value[3] - value[2], up) * per_cell,
            mix(value[2] - value[0], value[3] - value[1], right) * per_cell};
}

// Draws a goal within range of the spawn point. Returns the length of the shortest path to it.
HD float draw_goal(const PointgoalStepParams& p, int agent, int env, int layout) {
    Philox bits = next_draw(p.n_draws, agent, p.key0, p.key1);
    int spawn = checked(p.spawn_index[agent], p.n_spawns, p.error_flag, env, BAD_GOAL);
    long long row = (long long)layout * p.n_spawns + spawn;
    int column = checked(below(bits.a, p.n_in_range[row]), p.n_goals, p.error_flag, env, BAD_GOAL);
    int goal = p.in_range[row * p.n_goals + column];
    goal = checked(goal, p.n_goals, p.error_flag, env, BAD_GOAL);
    p.goal_index[agent] = goal;
    return p.lengths[row * p.n_goals + goal];
}

HD float ratio(float part, float whole) { return part / maxf(whole, 1e-3f); }

// Writes the metrics of an episode that ends, else zeros: success, success weighted by path length
// (SPL, Anderson et al. 2018), the same with the fraction of the distance covered in place of
// success (soft SPL, Datta et al. 2020), collisions.
HD void write_metrics(const PointgoalStepParams& p, int agent, int n, int ends, int success) {
    const float* progress = p.progress + agent;
    long long rows = n;
    float shortest = progress[SHORTEST * rows];
    float efficiency = ratio(shortest, maxf(shortest, progress[WALKED * rows]));
    float covered =
        clamp(1.f - ratio(progress[DISTANCE * rows], progress[START_DISTANCE * rows]), 0.f, 1.f);
    p.metrics[agent] = ends && success ? 1.f : 0.f;
    p.metrics[rows + agent] = ends && success ? efficiency : 0.f;
    p.metrics[2 * rows + agent] = ends ? (success ? 1.f : covered) * efficiency : 0.f;
    p.metrics[3 * rows + agent] = ends ? progress[COLLISIONS * rows] : 0.f;
}

HD void pointgoal_agent(const PointgoalStepParams& p, int agent) {
    if (!takes_part(p, agent))
        return;
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    int n = s.n_envs * s.n_agents, reset = begins(p, agent);
    long long rows = n;
    float* progress = p.progress + agent;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1];
    flag_nonfinite(p.error_flag, env, x, y, p.angles[agent]);
    Pose pose = pose_at(x, y, p.angles[agent]);
    if (reset)
        progress[SHORTEST * rows] = draw_goal(p, agent, env, layout);

    int goal = checked(p.goal_index[agent], p.n_goals, p.error_flag, env, BAD_GOAL);
    const float* goal_at = p.points + 2 * ((long long)layout * p.n_goals + goal);
    float dx = goal_at[0] - x, dy = goal_at[1] - y, straight = SQRT(dx * dx + dy * dy);
    float ahead = pose.cosine * dx + pose.sine * dy, left = pose.cosine * dy - pose.sine * dx;
    unsigned short* goal_obs = p.goal_obs + 3 * (long long)agent;
    goal_obs[0] = HALF_BITS(straight * 0.1f);
    goal_obs[1] = HALF_BITS(straight > 0.f ? ahead / straight : 1.f);
    goal_obs[2] = HALF_BITS(straight > 0.f ? left / straight : 0.f);

    int height = p.shapes[2 * layout], width = p.shapes[2 * layout + 1];
    Field field = {p.fields,
                   p.starts[layout] + (long long)goal * height * width,
                   p.last - p.fields,
                   height,
                   width,
                   p.origins[2 * layout],
                   p.origins[2 * layout + 1]};
    Reading reading = read_field(field, p.per_cell, x, y);
    float before = progress[DISTANCE * rows];
    float distance = is_finite(reading.distance) ? reading.distance : before;
    float moved_x = x - progress[PREVIOUS_X * rows], moved_y = y - progress[PREVIOUS_Y * rows];
    float moved = SQRT(moved_x * moved_x + moved_y * moved_y);
    float hit = p.free && p.free[agent] < 1.f ? 1.f : 0.f;
    progress[PREVIOUS_X * rows] = x;
    progress[PREVIOUS_Y * rows] = y;
    progress[DISTANCE * rows] = distance;
    progress[START_DISTANCE * rows] = reset ? distance : progress[START_DISTANCE * rows];
    progress[WALKED * rows] = reset ? 0.f : progress[WALKED * rows] + moved;
    progress[COLLISIONS * rows] = reset ? 0.f : progress[COLLISIONS * rows] + hit;

    int age = reset ? 0 : p.ages[agent] + 1, success = straight <= p.reach;
    int ends = !reset && (success || age >= p.limit);
    float cost = *p.cost + *p.walk_cost * moved;
    float reward = reset ? 0.f : before - distance + (success ? *p.bonus : 0.f) - cost;
    write_outcome(p, agent, reward, reset, age, ends, success);
    write_metrics(p, agent, n, ends, success);
    if (p.privileged) {
        float* privileged = p.privileged + N_PRIVILEGED * (long long)agent;
        privileged[0] = distance * 0.1f;
        privileged[1] = -(pose.cosine * reading.gradient_x + pose.sine * reading.gradient_y);
        privileged[2] = -(pose.cosine * reading.gradient_y - pose.sine * reading.gradient_x);
        privileged[3] = (float)(p.limit - age) / (float)p.limit;
    }
}

EACH(pointgoal_step, PointgoalStepParams, (p.scenery.n_envs * p.scenery.n_agents),
     p.scenery.n_threads, pointgoal_agent(p, i))
