// How agents move: a step ends early where the agent's disc, swept along it, touches a wall or
// another agent's disc.
#pragma once
#include "common/collision.h"
#include "common/group.h"
#include "params.h"

constexpr float INFLATION = 1.001f;  // of the radius: a stopped camera stays on its side of a wall
constexpr float SHORTENING = 0.99f;  // of the free part of a step

// The fraction of the step d after which an agent at p touches agent k, which moves too.
HD float sweep_agent(const PhysicsParams& p, int k, float px, float py, float dx, float dy,
                     float rho) {
    float kx = p.positions[2 * k], ky = p.positions[2 * k + 1];
    float other_dx = displacement(kx, p.velocity[2 * k], p.seconds);
    float other_dy = displacement(ky, p.velocity[2 * k + 1], p.seconds);
    return sweep_point(px - kx, py - ky, dx - other_dx, dy - other_dy, 2.f * rho);
}

// The fraction of the step d after which an agent at p touches object i, if that is an obstacle.
HD float sweep_object(const ObjectsParams& o, int i, float px, float py, float dx, float dy,
                      float rho) {
    Object object = objects_of(o)[i];
    float x = object.x, y = object.y, reach = rho + 1.5f * object.size;  // beyond crates' corners
    if (!is_obstacle(object) || !boxes_meet(px, py, dx, dy, x, y, x, y, reach))
        return NO_CONTACT;
    int k = i % o.n_objects;
    if (o.shapes[k] == DISC)
        return sweep_point(px - x, py - y, dx, dy, rho + object.size);
    float contact = NO_CONTACT;
    Pose pose = pose_at(x, y, object.angle);
    Range lines = lines_of(o, k);
    for (int l = lines.first; l < lines.end; l++) {
        Float4 line = line_of(o, l, object, pose);
        contact = minf(contact, sweep_segment(px, py, dx, dy, line.x, line.y, line.z, line.w, rho));
    }
    return contact;
}

// Writes the free fraction of agent a's step. The threads of `group` divide the walls, agents and
// objects among them. `sweep_walls` returns the earliest contact with walls of an agent at p that
// moves by d, as sweep_walls(px, py, dx, dy, rho).
template <int with_objects, class Group, class SweepWalls>
HD void sweep(const PhysicsParams& p, const Group& group, int env, int a, SweepWalls sweep_walls) {
    int n_agents = p.scenery.n_agents, n_objects = p.objects.n_objects, i = env * n_agents + a;
    float rho = p.scenery.radius * INFLATION;
    float px = p.positions[2 * i], py = p.positions[2 * i + 1];
    float dx = displacement(px, p.velocity[2 * i], p.seconds);
    float dy = displacement(py, p.velocity[2 * i + 1], p.seconds);
    float contact = sweep_walls(px, py, dx, dy, rho);
    for (int other = group.rank; other < n_agents; other += group.SIZE)
        if (other != a)
            contact = minf(contact, sweep_agent(p, env * n_agents + other, px, py, dx, dy, rho));
    if (with_objects)
        for (int k = group.rank; k < n_objects; k += group.SIZE)
            contact =
                minf(contact, sweep_object(p.objects, env * n_objects + k, px, py, dx, dy, rho));
    contact = least(group, contact);
    if (group.rank == 0)
        p.progress[i] = contact <= 1.f ? clamp(SHORTENING * contact, 0.f, 1.f) : 1.f;
}

// Damps agent i's velocities and adds a move, rotated to the agent's heading.
HD void accelerate(const PhysicsParams& p, int i, float ahead, float left, float turn) {
    float s, c;
    sincos_degrees(p.angles[i], s, c);
    float* velocity = p.velocity + 2 * i;
    velocity[0] = p.retained * velocity[0] + (c * ahead - s * left);
    velocity[1] = p.retained * velocity[1] + (s * ahead + c * left);
    p.angvelocity[i] = p.retained * p.angvelocity[i] + turn;
}

// Applies agent i's discrete action: the move that it selects.
HD void apply_action(const PhysicsParams& p, int env, int i) {
    long long action = p.actions[i];
    if (action < 0 || action >= p.n_moves) {
        flag_error(p.error_flag, env, BAD_ACTION);
        action = 0;
    }
    const float* move = p.moves + 3 * action;
    accelerate(p, i, move[0], move[1], move[2]);
}

// Applies agent i's continuous action: the sum of all moves, each weighted with a number of it.
HD void apply_controls(const PhysicsParams& p, int env, int i) {
    const float* controls = p.controls + (long long)p.n_moves * i;
    float ahead = 0.f, left = 0.f, turn = 0.f;
    for (int k = 0; k < p.n_moves; k++) {
        if (controls[k] != controls[k]) {
            flag_error(p.error_flag, env, NAN_ACTION);
            continue;
        }
        float weight = clamp(controls[k], -1.f, 1.f);
        const float* move = p.moves + 3 * k;
        ahead += weight * move[0];
        left += weight * move[1];
        turn += weight * move[2];
    }
    accelerate(p, i, ahead, left, turn);
}

// Moves agent a by the free part of its step. An agent that hit something stops.
HD void advance(const PhysicsParams& p, int env, int a) {
    int i = env * p.scenery.n_agents + a;
    float progress = p.progress[i];
    float* position = p.positions + 2 * i;
    float* velocity = p.velocity + 2 * i;
    position[0] += progress * displacement(position[0], velocity[0], p.seconds);
    position[1] += progress * displacement(position[1], velocity[1], p.seconds);
    p.angles[i] = wrap_degrees(p.angles[i] + progress * (p.angvelocity[i] * p.seconds));
    flag_nonfinite(p.error_flag, env, position[0], position[1], p.angles[i]);
    if (progress < 1.f) {
        velocity[0] = 0.f;
        velocity[1] = 0.f;
        p.angvelocity[i] = 0.f;
    }
}
