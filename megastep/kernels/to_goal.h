// Where an agent's goal lies: straight, and by the shortest way, which is read from the field of
// distances to that goal between the centres of four cells.
#pragma once
#include "errors.h"

struct Field {
    const unsigned short* cells;  // fp16
    int height, width;
    float x, y;  // the centre of the first cell
};

// A field's value and its slope along x and y, per metre. A cell that nothing leads from holds
// infinity: the others speak for it. Where none of the four holds a number the value is infinite.
HD float interpolate(const Field& f, float per_cell, float x, float y, float& along_x,
                     float& along_y) {
    float u = (x - f.x) * per_cell, v = (y - f.y) * per_cell;
    int column = (int)clamp(u, 0.f, (float)(f.width - 2));
    int row = (int)clamp(v, 0.f, (float)(f.height - 2));
    float right = clamp(u - (float)column, 0.f, 1.f), up = clamp(v - (float)row, 0.f, 1.f);
    float value[4], weight[4] = {(1.f - right) * (1.f - up), right * (1.f - up),
                                 (1.f - right) * up, right * up};
    float total = 0.f, sum = 0.f, mean = 0.f;
    int n_known = 0;
    for (int i = 0; i < 4; i++) {
        value[i] = HALF_VALUE(f.cells[(long long)(row + i / 2) * f.width + column + i % 2]);
        if (is_finite(value[i])) {
            sum += weight[i] * value[i];
            total += weight[i];
            mean += value[i];
            n_known++;
        }
    }
    along_x = along_y = 0.f;
    if (!n_known)
        return INF_VALUE;
    float found = total > 0.f ? sum / total : mean / (float)n_known;
    for (int i = 0; i < 4; i++)
        value[i] = is_finite(value[i]) ? value[i] : found;
    along_x = mix(value[1] - value[0], value[3] - value[2], up) * per_cell;
    along_y = mix(value[2] - value[0], value[3] - value[1], right) * per_cell;
    return found;
}

HD void find_goal(const ToGoalParams& p, int agent) {
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, layout = layout_of(s, env, p.error_flag);
    int goal = p.goals[agent];
    if ((unsigned int)goal >= (unsigned int)p.n_goals) {
        flag_error(p.error_flag, env, BAD_GOAL);
        goal = 0;
    }
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1];
    flag_nonfinite(p.error_flag, env, x, y, p.angles[agent]);
    Pose pose = pose_at(x, y, p.angles[agent]);

    const float* at = p.points + 2 * ((long long)layout * p.n_goals + goal);
    float dx = at[0] - x, dy = at[1] - y;
    float straight = SQRT(dx * dx + dy * dy);
    float ahead = pose.cosine * dx + pose.sine * dy, left = pose.cosine * dy - pose.sine * dx;
    int is_there = straight == 0.f;
    p.bearing[3 * agent] = HALF_BITS(straight * 0.1f);
    p.bearing[3 * agent + 1] = HALF_BITS(is_there ? 1.f : ahead / straight);
    p.bearing[3 * agent + 2] = HALF_BITS(is_there ? 0.f : left / straight);
    p.straight[agent] = straight;

    int height = p.shapes[2 * layout], width = p.shapes[2 * layout + 1];
    Field field = {p.fields + p.starts[layout] + (long long)goal * height * width, height, width,
                   p.origins[2 * layout], p.origins[2 * layout + 1]};
    float along_x, along_y;
    p.distance[agent] = interpolate(field, p.per_cell, x, y, along_x, along_y);
    p.descent[2 * agent] = -(pose.cosine * along_x + pose.sine * along_y);
    p.descent[2 * agent + 1] = -(pose.cosine * along_y - pose.sine * along_x);
}
