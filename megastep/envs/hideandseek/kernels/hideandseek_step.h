// One step of hide and seek, after all have moved and before they are rendered. Where an episode
// starts, puts agents and bodies where one of the layout's starts has them. Agents grab and lock
// bodies; then it is settled who is seen.
#pragma once
#include "common/line_of_sight.h"
#include "common/philox.h"
#include "common/step.h"

constexpr int GRAB = 7;     // actions beside the moves: grab a body or let go
constexpr int LOCK = 8;     // lock or unlock a body
constexpr int N_KINDS = 3;  // of bodies, each with a colour; those of the teams' locks come next
constexpr int STATE = 9;    // numbers that an agent observes beside images
constexpr int TALLY = 5;    // of an episode so far: steps unseen, and four of PHASE
constexpr int PHASE = 4;    // box moved and locked, ramp moved and locked
constexpr int METRICS = 9;  // steps unseen, and PHASE at the end of either phase
constexpr int PRIVILEGED_PER_AGENT = 5;  // numbers that a critic sees of each other agent
constexpr int PRIVILEGED_PER_BODY = 7;

// N environments of A agents, hiders first, and K bodies: boxes, elongated ones, ramps. D layouts,
// M starts per layout. Positions are written where an episode starts. Metrics: the fraction of the
// play in which no hider was seen; the furthest that a box was moved by the end of the preparation,
// and by that of the episode, and likewise how many were locked; the same four of ramps.
struct HideAndSeekStepParams : DrawnGameParams {
    ObjectsParams objects;
    const long long* actions;  // (N, A) null: none was taken
    const float* starts;       // (D, M, A + K, 2) metres, of agents and bodies
    float* placed;             // (N, K, 2) in and out, as the next: where bodies were at the start
    float* tally;              // (N, TALLY) of the episode so far
    int* preps;                // (N) in and out: steps of the preparation of the episode
    unsigned char* seen;       // (N, A) out: hiders that are seen, seekers that see one
    unsigned char* blind;      // (N, A) out: seekers that wait
    unsigned short* state;     // (N, A, STATE) out: fp16
    float* privileged;         // (N, A, .) for a critic; null: none
    int n_starts;              // M
    int n_hiders;              // of the A agents
    int n_boxes;               // of the K bodies, as the next
    int n_long;                // elongated boxes
    int limit;                 // steps per episode
    int prep;                  // steps of a preparation at most, and as agents see it
    int min_prep;              // at least
    float view_cosine;         // of half the field of view
    float reach;               // metres from an agent's centre to a body that it grabs or locks
    int grab_elevated;         // 1: elevated agents may grab
};

HD Pose pose_of(const HideAndSeekStepParams& p, int i) {
    return pose_at(p.positions[2 * i], p.positions[2 * i + 1], p.angles[i]);
}

HD void start_episode(const HideAndSeekStepParams& p, int env, int layout) {
    int n_agents = p.scenery.n_agents, n_bodies = p.objects.n_bodies;
    Philox bits = next_draw(p.n_draws, env, p.key0, p.key1);
    long long row = (long long)layout * p.n_starts + below(bits.a, p.n_starts);
    const float* starts = p.starts + 2 * row * (n_agents + n_bodies);
    p.preps[env] = p.min_prep + below(bits.b, p.prep - p.min_prep + 1);
    for (int i = 0; i < 2 * n_agents; i++)
        p.positions[2 * env * n_agents + i] = starts[i];
    for (int k = 0; k < n_bodies; k++) {
        const float* at = starts + 2 * (n_agents + k);
        bits = next_draw(p.n_draws, env, p.key0, p.key1);
        Object& object = objects_of(p.objects, env)[k];
        object.x = at[0];
        object.y = at[1];
        object.angle = 360.f * unit_float(bits.a) - 180.f;
        object.visible = 1;
        rest(bodies_of(p.objects, env)[k]);
        float* placed = p.placed + 2 * ((long long)env * n_bodies + k);
        placed[0] = at[0];
        placed[1] = at[1];
    }
    for (int i = 0; i < TALLY; i++)
        p.tally[TALLY * env + i] = 0.f;
}

// From an agent at (x, y) to the nearest point of a rectangular object k: 0 if it is over that.
HD Float4 nearest_point(const ObjectsParams& o, int k, const Object& object, float x, float y) {
    Pose pose = pose_at(object.x, object.y, object.angle);
    float dx = x - object.x, dy = y - object.y;
    float half = -object.size * first_y_of(o, k);
    float along = pose.cosine * dx + pose.sine * dy, aside = pose.cosine * dy - pose.sine * dx;
    float back = clamp(along, -object.size, object.size) - along,
          side = clamp(aside, -half, half) - aside;
    return {pose.cosine * back - pose.sine * side, pose.sine * back + pose.cosine * side,
            back * back + side * side, 0.f};
}

// Returns 1 if what is (dx, dy) from an agent is in its field of view.
HD int is_in_view(const HideAndSeekStepParams& p, const Pose& pose, float dx, float dy) {
    float ahead = pose.cosine * dx + pose.sine * dy;
    return ahead >= p.view_cosine * SQRT(dx * dx + dy * dy);
}

// Returns 1 if a wall is between an agent and a point (dx, dy) from it, which may touch a wall.
HD int is_behind_wall(const HideAndSeekStepParams& p, const Walls& walls, const Pose& pose,
                      float dx, float dy) {
    int is_cut = 0;
    for (int i = walls.first_wall; i < walls.end_wall && !is_cut; i++) {
        Float4 wall = LOAD((const Float4*)p.scenery.walls + i);
        is_cut = cuts(wall.x, wall.y, wall.z, wall.w, pose.x, pose.y, 0.9f * dx, 0.9f * dy);
    }
    return is_cut;
}

// The body that agent a grabs or locks: what it holds, else the nearest within its reach and field
// of view; -1 if there is none.
HD int target_of(const HideAndSeekStepParams& p, const Walls& walls, int env, int a) {
    const ObjectsParams& o = p.objects;
    for (int k = 0; k < o.n_bodies; k++)
        if (bodies_of(p.objects, env)[k].holder == a)
            return k;
    Pose pose = pose_of(p, env * p.scenery.n_agents + a);
    float nearest2 = p.reach * p.reach;
    int target = -1;
    for (int k = 0; k < o.n_bodies; k++) {
        Float4 to = nearest_point(o, k, objects_of(p.objects, env)[k], pose.x, pose.y);
        if (!(to.z < nearest2) || !is_in_view(p, pose, to.x, to.y) ||
            is_behind_wall(p, walls, pose, to.x, to.y))
            continue;
        nearest2 = to.z;
        target = k;
    }
    return target;
}

HD int is_elevated(const HideAndSeekStepParams& p, int i) {
    return p.objects.elevated && p.objects.elevated[i] > 0;
}

// Has agent a grab, let go, lock or unlock.
HD void use_hand(const HideAndSeekStepParams& p, const Walls& walls, int env, int a, int locks) {
    int target = target_of(p, walls, env, a), team = a >= p.n_hiders;
    if (target < 0)
        return;
    Body& body = bodies_of(p.objects, env)[target];
    int may_grab = p.grab_elevated || !is_elevated(p, env * p.scenery.n_agents + a);
    if (!locks && body.holder == a) {
        body.holder = -1;
    } else if (!locks && may_grab && body.holder < 0 && !body.locked) {
        body.holder = a;
        body.grabbed = 1;
    } else if (locks && !body.locked) {
        rest(body);
        body.locked = 1;
        body.owner = team;
    } else if (locks && body.owner == team) {
        body.locked = 0;
        body.owner = -1;
    }
}

// A bit for each agent: hiders that are seen and seekers that see one. As in the original, a seeker
// sees what is in its field of view.
template <class Group>
HD unsigned int find_seen(const HideAndSeekStepParams& p, const Group& group, const Walls& walls,
                          int env) {
    int n_agents = p.scenery.n_agents, first = env * n_agents;
    unsigned int seen = 0;
    for (int s = p.n_hiders; s < n_agents; s++) {
        Pose pose = pose_of(p, first + s);
        for (int h = 0; h < p.n_hiders; h++) {
            float dx = p.positions[2 * (first + h)] - pose.x;
            float dy = p.positions[2 * (first + h) + 1] - pose.y;
            if (is_in_view(p, pose, dx, dy) &&
                is_visible<1>(p.scenery, p.objects, group, walls, env, pose.x, pose.y, dx, dy))
                seen |= 1u << h | 1u << s;
        }
    }
    return seen;
}

// Writes how far the bodies [first, end) were moved at most, and how many are locked.
HD void measure(const HideAndSeekStepParams& p, int env, int first, int end, float* out) {
    float furthest2 = 0.f, n_locked = 0.f;
    for (int k = first; k < end; k++) {
        const Object& object = objects_of(p.objects, env)[k];
        const float* placed = p.placed + 2 * ((long long)env * p.objects.n_bodies + k);
        float dx = object.x - placed[0], dy = object.y - placed[1];
        furthest2 = maxf(furthest2, dx * dx + dy * dy);
        n_locked += (float)bodies_of(p.objects, env)[k].locked;
    }
    out[0] = SQRT(furthest2);
    out[1] = n_locked;
}

HD void measure_all(const HideAndSeekStepParams& p, int env, float* out) {
    int n_boxes = p.n_boxes + p.n_long;
    measure(p, env, 0, n_boxes, out);
    measure(p, env, n_boxes, p.objects.n_bodies, out + 2);
}

// What agent a knows: its team, the preparation, the fraction of the phase that is left, both as if
// the preparation were as long as it can be; whether it is elevated, holds a body; of the body that
// it would grab or lock, whether there is one, it is locked by its own team or the other one, or
// another agent holds it.
HD void write_state(const HideAndSeekStepParams& p, const Walls& walls, int env, int a, int age) {
    int target = target_of(p, walls, env, a), team = a >= p.n_hiders, is_prep = age < p.prep;
    int left = (is_prep ? p.prep : p.limit) - age, of = is_prep ? p.prep : p.limit - p.prep;
    Body body = {};
    if (target >= 0)
        body = bodies_of(p.objects, env)[target];
    int is_there = target >= 0, holds = is_there && body.holder == a;
    float values[STATE] = {(float)!team,
                           (float)is_prep,
                           (float)left / (float)of,
                           (float)is_elevated(p, env * p.scenery.n_agents + a),
                           (float)holds,
                           (float)is_there,
                           (float)(is_there && body.locked && body.owner == team),
                           (float)(is_there && body.locked && body.owner != team),
                           (float)(is_there && body.holder >= 0 && !holds)};
    unsigned short* out = p.state + (long long)STATE * (env * p.scenery.n_agents + a);
    for (int i = 0; i < STATE; i++)
        out[i] = HALF_BITS(values[i]);
}

// A pose in an agent's frame, in tens of metres, and the cosine and sine of its angle there.
HD float* write_pose(const Pose& pose, float x, float y, float degrees, float* out) {
    Pose other = pose_at(x, y, degrees);
    float dx = x - pose.x, dy = y - pose.y, minus_sine = -pose.sine;
    *out++ = 0.1f * (pose.cosine * dx + pose.sine * dy);
    *out++ = 0.1f * (pose.cosine * dy + minus_sine * dx);
    *out++ = pose.cosine * other.cosine + pose.sine * other.sine;
    *out++ = pose.cosine * other.sine + minus_sine * other.cosine;
    return out;
}

// Writes what a critic sees of agent a: whether it is seen or sees, the other agents, its own
// team's first, and the bodies.
HD void write_privileged(const HideAndSeekStepParams& p, int env, int a, unsigned int seen) {
    int n_agents = p.scenery.n_agents, n_bodies = p.objects.n_bodies, i = env * n_agents + a;
    int team = a >= p.n_hiders, n_first = team ? p.n_hiders : 0;
    int n_own = team ? n_agents - p.n_hiders : p.n_hiders;
    Pose pose = pose_of(p, i);
    float* out = p.privileged + (long long)i * (1 + PRIVILEGED_PER_AGENT * (n_agents - 1) +
                                                PRIVILEGED_PER_BODY * n_bodies);
    *out++ = (float)(seen >> a & 1);
    for (int k = 1; k < n_agents; k++) {
        int mate = n_first + (a - n_first + k) % n_own, rest = k - n_own;
        int b = k < n_own ? mate : team ? rest : p.n_hiders + rest, j = env * n_agents + b;
        out = write_pose(pose, p.positions[2 * j], p.positions[2 * j + 1], p.angles[j], out);
        *out++ = (float)(seen >> b & 1);
    }
    for (int k = 0; k < n_bodies; k++) {
        const Object& object = objects_of(p.objects, env)[k];
        const Body& body = bodies_of(p.objects, env)[k];
        out = write_pose(pose, object.x, object.y, object.angle, out);
        *out++ = (float)(body.locked && body.owner == team);
        *out++ = (float)(body.locked && body.owner != team);
        *out++ = (float)(body.holder >= 0);
    }
}

// Writes the metrics of an episode that ends, else 0.
HD void write_metrics(const HideAndSeekStepParams& p, int i, int prep, const float* tally,
                      const float* phase, int ends) {
    long long n = (long long)p.scenery.n_envs * p.scenery.n_agents;
    int n_played = p.limit - maxi(prep, 1) + 1;
    p.metrics[i] = ends ? tally[0] / (float)n_played : 0.f;
    for (int k = 0; k < PHASE; k++) {
        p.metrics[(1 + 2 * k) * n + i] = ends ? tally[1 + k] : 0.f;
        p.metrics[(2 + 2 * k) * n + i] = ends ? phase[k] : 0.f;
    }
}

template <class Group>
HD void hideandseek_env(const HideAndSeekStepParams& p, const Group& group, int env) {
    int n_agents = p.scenery.n_agents, first = env * n_agents, reset = p.ended[first];
    int layout = layout_of(p.scenery, env, p.error_flag), old_age = p.ages[first];
    Walls walls = walls_of(p.scenery, layout);
    sync(group);
    if (group.rank == 0 && reset)
        start_episode(p, env, layout);
    else if (group.rank == 0 && p.actions)
        for (int a = 0; a < n_agents; a++) {
            long long action = p.actions[first + a];
            int is_hand = action == GRAB || action == LOCK;
            if (is_hand && (a < p.n_hiders || old_age >= p.preps[env]))
                use_hand(p, walls, env, a, action == LOCK);
        }
    sync(group);
    int age = reset ? 0 : old_age + 1, prep = p.preps[env], is_prep = age < prep;
    int ends = !reset && age >= p.limit;
    unsigned int seen = is_prep ? 0u : find_seen(p, group, walls, env);
    int is_seen = (seen & ((1u << p.n_hiders) - 1u)) != 0;
    float tally[TALLY], phase[PHASE] = {};
    for (int i = 0; i < TALLY; i++)
        tally[i] = p.tally[TALLY * env + i];
    if (!reset && !is_prep)
        tally[0] += (float)!is_seen;
    if (!reset && (age == prep || ends))
        measure_all(p, env, phase);
    for (int i = 0; i < PHASE && !reset && age == prep; i++)
        tally[1 + i] = phase[i];
    sync(group);
    for (int i = group.rank; i < TALLY; i += Group::SIZE)
        p.tally[TALLY * env + i] = tally[i];
    for (int a = group.rank; a < n_agents; a += Group::SIZE) {
        int i = first + a, team = a >= p.n_hiders;
        flag_nonfinite(p.error_flag, env, p.positions[2 * i], p.positions[2 * i + 1], p.angles[i]);
        float reward = reset || is_prep ? 0.f : team == is_seen ? 1.f : -1.f;
        write_outcome(p, i, reward, reset, age, ends, 1);
        write_metrics(p, i, prep, tally, phase, ends);
        p.seen[i] = (unsigned char)(seen >> a & 1);
        p.blind[i] = (unsigned char)(team && is_prep);
        write_state(p, walls, env, a, age);
        if (p.privileged)
            write_privileged(p, env, a, seen);
    }
    for (int k = group.rank; k < p.objects.n_bodies; k += Group::SIZE) {
        const Body& body = bodies_of(p.objects, env)[k];
        int kind = k < p.n_boxes ? 0 : k < p.n_boxes + p.n_long ? 1 : 2;
        objects_of(p.objects, env)[k].colour = body.locked ? N_KINDS + body.owner : kind;
    }
}

EACH_WARP(hideandseek_step, HideAndSeekStepParams, p.scenery.n_envs,
          threads_for_agents(p.scenery, 256), hideandseek_env(p, group, i))

// ---- Before and after a step ----

// The actions of B lanes as agents move by them: 0 of those that cannot move, or do not.
struct HideAndSeekMovesParams {
    const long long* actions;    // (B)
    const int* ages;             // (B)
    const unsigned char* ended;  // (B)
    const int* preps;            // (N) steps of the preparation
    long long* out;              // (B)
    int n_lanes;                 // B
    int n_agents;                // A
    int n_hiders;
};

// The action by which a lane moves. One outside of the action space stays, for physics to flag.
HD long long move_of(const HideAndSeekMovesParams& p, int i) {
    long long action = p.actions[i];
    if (action < 0 || action > LOCK)
        return action;
    int waits = p.ages[i] < p.preps[i / p.n_agents] && i % p.n_agents >= p.n_hiders;
    return p.ended[i] || waits || action >= GRAB ? 0 : action;
}

EACH(hideandseek_moves, HideAndSeekMovesParams, p.n_lanes, 1, p.out[i] = move_of(p, i))

// B lanes, R pixels. The images of seekers that wait are black.
struct HideAndSeekImagesParams {
    const unsigned char* blind;  // (B)
    unsigned short* rgb;         // (B, 3, R) fp16: set to 0 where blind
    unsigned short* depth;       // (B, R) likewise
    int n_lanes;                 // B
    int n_pixels;                // R
};

HD void blacken(const HideAndSeekImagesParams& p, int lane) {
    int n = p.n_pixels;
    for (int i = 0; i < 3 * n && p.blind[lane]; i++)
        p.rgb[3ll * n * lane + i] = 0;
    for (int i = 0; i < n && p.blind[lane]; i++)
        p.depth[(long long)n * lane + i] = 0;
}

EACH(hideandseek_images, HideAndSeekImagesParams, p.n_lanes, 1, blacken(p, i))
