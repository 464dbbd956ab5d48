// How agents and objects move that push each other. A step is divided into substeps, as in Box2D
// 3's "soft step". Each finds where hulls touch, changes velocities by impulses until nothing comes
// closer there than it may, moves everything, and shifts apart what overlaps nonetheless.
//
// Agents are discs of 1 kg, driven towards the velocity that their actions ask for. Bodies are
// objects that can be pushed. Both have a slot, the agents first. Touches are solved in the order
// of their slots, and of walls and other objects behind them; threads of a group take those that
// share no slot at the same time, which gives the same bits.
//
// See https://box2d.org/posts/2024/02/solver2d/ for solvers of this kind.
#pragma once
#include "common/line_of_sight.h"
#include "draw_objects.h"
#include "hulls.h"
#include "physics.h"

constexpr int MAX_CANDIDATES = 128;  // pairs of hulls that may touch in a step
constexpr int MAX_TOUCHES = 64;      // that do in a substep
constexpr int BODIES_BYTES = 8772;   // of shared memory per environment with all slots
constexpr int SLOT_BYTES = 164;      // of a slot
constexpr int SUBSTEPS = 4;
constexpr int ITERATIONS = 3;
constexpr float SLOP = 0.002f;         // metres of overlap that are left alone
constexpr float MAX_OVERLAP = 0.005f;  // metres; a substep that would lead to more is taken back
constexpr float MAX_SHIFT = 0.02f;     // metres by which overlaps shrink in a substep
constexpr float LIGHT = 100.f;  // how much more agents give way to bodies in shifts than by mass
constexpr float MAX_STRETCH = 0.25f;  // metres that an agent and what it holds are out of place
constexpr float MIN_LIMIT = 0.2f;     // m/s that any slot may have beyond the fastest at the start
constexpr float AGENT_MASS = 1.f;     // kg
constexpr float GRAVITY = 9.81f;      // m/s2
constexpr float EDGE = 0.05f;  // metres before a ramp's high side at which an agent is over it
constexpr float ARM = 0.93f;   // of friction with the floor, per radius of gyration: within 7 %
constexpr float RADIANS = 0.017453292519943295f;
constexpr float DEGREES = 57.29577951308232f;

// What a candidate's second hull is.
constexpr int SLOT = 0;
constexpr int WALL = 1;
constexpr int OBJECT = 2;

struct Motion {
    float x, y, turn;
};

// An agent or a body. Of one that cannot move, the inverse mass is 0.
struct Slot {
    Hull hull, before;  // now, and before the substep
    float angle, angle_before;
    Motion velocity, shift;  // m/s and rad/s; metres and radians
    float wish_x, wish_y;    // m/s, 0 of bodies
    float inv_mass, inv_inertia;
    float drag;                       // newtons, at most, between slot and floor
    float drag_x, drag_y, drag_turn;  // impulses in this substep
    float hold_x, hold_y, hold_turn;  // of what is held, as the next
    float hold[3];                    // impulse and torque in this substep
    float load, load_turn;            // their sums over all substeps
    float extent, speed;
    signed char exists, holder, hit, overlaps, taken_back, last;
    signed char elevated;  // of agents, as in ObjectsParams, but 1 for all above 0
    int unused;            // threads' slots are an odd number of words apart, in different banks
};

// One environment in a step: a column per candidate and touch. A GPU has memory for the slots that
// there are.
struct Bodies {
    int candidates[MAX_CANDIDATES];
    signed char touch_a[MAX_TOUCHES], touch_b[MAX_TOUCHES], levels[MAX_TOUCHES];
    Touch touches[MAX_TOUCHES];
    float impulses[MAX_TOUCHES][2];
    int n_levels;
    Slot slots[MAX_SLOTS];
};

static_assert(sizeof(Bodies) == BODIES_BYTES && sizeof(Slot) == SLOT_BYTES,
              "Python allocates shared memory for them");

HD int n_slots_of(const PhysicsBodiesParams& p) { return p.scenery.n_agents + p.objects.n_bodies; }

// Fills in an agent's slot. Its disc is larger than the one that no wall may enter, by what may
// overlap. Its velocity is the real one; its action changes what it wishes.
HD void begin_agent(const PhysicsBodiesParams& p, Bodies& b, int env, int a) {
    Slot& slot = b.slots[a];
    int i = env * p.scenery.n_agents + a;
    slot.angle = p.angles[i];
    slot.hull = hull_at(p.positions[2 * i], p.positions[2 * i + 1], slot.angle,
                        p.scenery.radius * INFLATION + MAX_OVERLAP, -1.f);
    slot.velocity.x = p.velocity[2 * i];
    slot.velocity.y = p.velocity[2 * i + 1];
    if (p.actions)
        apply_action(p, env, i);
    if (p.controls)
        apply_controls(p, env, i);
    slot.wish_x = p.velocity[2 * i];
    slot.wish_y = p.velocity[2 * i + 1];
    slot.velocity.turn = p.angvelocity[i] * RADIANS;
    slot.inv_mass = 1.f / AGENT_MASS;
    slot.inv_inertia = 0.f;  // nothing but its action turns it
    slot.drag = p.force;
    slot.exists = 1;
    slot.holder = -1;
    slot.extent = slot.hull.hx;
}

// Fills in the slot of a body, whose object is at rest if it is not to move.
HD void begin_body(const PhysicsBodiesParams& p, Bodies& b, int env, int k) {
    const ObjectsParams& o = p.objects;
    int object_index = object_of_body(o, k);
    Slot& slot = b.slots[p.scenery.n_agents + k];
    Object object = objects_of(o)[env * o.n_objects + object_index];
    Body body = bodies_of(o)[env * o.n_bodies + k];
    float hy = half_width_of(o, object_index, object.size);
    slot.hull = hull_at(object.x, object.y, object.angle, object.size, hy);
    slot.angle = object.angle;
    slot.exists = is_obstacle(object) && is_drawn(object);
    slot.extent = extent_of(object.size, hy);
    int moves =
        slot.exists && body.movable && !body.locked && body.mass > 0.f && is_finite(body.mass);
    float gyration2 = hy < 0.f ? 0.5f * object.size * object.size
                               : (object.size * object.size + hy * hy) * (1.f / 3.f);
    slot.inv_mass = moves ? 1.f / body.mass : 0.f;
    slot.inv_inertia = moves ? 1.f / (body.mass * gyration2) : 0.f;
    slot.velocity.x = moves ? body.vx : 0.f;
    slot.velocity.y = moves ? body.vy : 0.f;
    slot.velocity.turn = moves ? body.turning * RADIANS : 0.f;
    slot.wish_x = slot.wish_y = 0.f;
    slot.drag = body.friction * body.mass * GRAVITY;
    slot.load = 0.f;
    slot.load_turn = 0.f;
    slot.hold_x = body.hold_x;
    slot.hold_y = body.hold_y;
    slot.hold_turn = body.hold_turn;
    slot.holder = moves && is_agent(body.holder, p.scenery.n_agents) ? body.holder : -1;
}

// Stores where a body is in its holder's frame if it was just grabbed. Else has the holder let go
// if one of the two was put elsewhere, or if it is elevated and may not grab.
HD void begin_hold(const PhysicsBodiesParams& p, Bodies& b, int env, int k) {
    Slot& slot = b.slots[p.scenery.n_agents + k];
    int a = slot.holder;
    if (a < 0)
        return;
    const Hull& agent = b.slots[a].hull;
    float dx = slot.hull.x - agent.x, dy = slot.hull.y - agent.y;
    float x = agent.cosine * dx + agent.sine * dy, y = agent.cosine * dy - agent.sine * dx;
    Body& body = bodies_of(p.objects)[env * p.objects.n_bodies + k];
    if (body.grabbed) {
        body.grabbed = 0;
        body.hold_x = slot.hold_x = x;
        body.hold_y = slot.hold_y = y;
        body.hold_turn = slot.hold_turn = slot.angle - b.slots[a].angle;
    }
    float off_x = x - slot.hold_x, off_y = y - slot.hold_y;
    int is_up = b.slots[a].elevated > 0 && !p.grab_elevated;
    if (is_up || off_x * off_x + off_y * off_y > MAX_STRETCH * MAX_STRETCH)
        slot.holder = -1;
}

// The speed of the fastest point of a hull.
HD float speed_of(float vx, float vy, float turning, float extent) {
    return SQRT(vx * vx + vy * vy) + ABS(turning) * extent;
}

// How fast a slot may become in a step: what is held, as fast as its holder moves and turns it.
HD float top_speed(const Bodies& b, int i, int n_agents) {
    const Slot& slot = b.slots[i];
    if (!slot.exists)
        return 0.f;
    float turning = slot.velocity.turn;
    float now = speed_of(slot.velocity.x, slot.velocity.y, turning, slot.extent);
    if (i < n_agents)
        return maxf(now, speed_of(slot.wish_x, slot.wish_y, turning, slot.extent));
    if (slot.holder < 0)
        return now;
    const Motion& holder = b.slots[slot.holder].velocity;
    float arm = speed_of(slot.hold_x, slot.hold_y, 1.f, slot.extent);
    return maxf(now, speed_of(holder.x, holder.y, holder.turn, arm));
}

// Returns 1 if agent a, before the low side of the ramp in a slot and within reach of it, drives
// ahead in its direction: from the low side at -hx to the high one.
HD int drives_up(const Bodies& b, int a, int slot, float reach) {
    const Hull &agent = b.slots[a].hull, &ramp = b.slots[slot].hull;
    float dx = agent.x - ramp.x, dy = agent.y - ramp.y;
    float x = ramp.cosine * dx + ramp.sine * dy + ramp.hx, y = ramp.cosine * dy - ramp.sine * dx;
    return x < 0.f && x > -reach && ABS(y) <= ramp.hy &&
           ramp.cosine * b.slots[a].wish_x + ramp.sine * b.slots[a].wish_y > 0.f;
}

// Returns 1 if agent a is over the high side of the ramp in a slot.
HD int is_over(const Bodies& b, int a, int slot) {
    const Hull &agent = b.slots[a].hull, &ramp = b.slots[slot].hull;
    float x = ramp.cosine * (agent.x - ramp.x) + ramp.sine * (agent.y - ramp.y);
    return x + agent.hx + EDGE >= ramp.hx;
}

// Returns what agent a passes in this step, as `elevated` in ObjectsParams. It stays on a ramp, and
// after the last of its steps on other bodies, until it overlaps none.
HD int elevation_of(const PhysicsBodiesParams& p, const Bodies& b, int env, int a) {
    const ObjectsParams& o = p.objects;
    int n_agents = p.scenery.n_agents, up = o.elevated[env * n_agents + a], stays = 0;
    for (int k = 0; k < o.n_bodies && up <= 1 && !stays; k++)
        stays = (up == 1 || up == -1 - k) && b.slots[n_agents + k].exists &&
                gap_of(touch(b.slots[a].hull, b.slots[n_agents + k].hull)) < 0.f;
    if (up > 1)
        up--;
    else if (!stays)
        up = 0;
    float reach = b.slots[a].extent + top_speed(b, a, n_agents) * p.seconds;
    for (int k = 0; k < o.n_bodies && up == 0; k++)
        if (o.shapes[object_of_body(o, k)] == RAMP && b.slots[n_agents + k].exists &&
            drives_up(b, a, n_agents + k, reach))
            up = -1 - k;
    return up < 0 && is_over(b, a, n_agents - 1 - up) ? p.ramp_steps : up;
}

HD int passes_slot(int elevated, int slot, int n_agents) {
    return slot >= n_agents && (elevated > 0 || elevated == n_agents - 1 - slot);
}

// Lists `candidate` if this thread has one. If the list is full, its slots do not move in this
// step.
template <class Group>
HD void add_candidate(const Group& group, Bodies& b, int has, int a, int kind, int index, int& n) {
    int at = append(group, has, n);
    if (at >= 0 && at < MAX_CANDIDATES)
        b.candidates[at] = a | kind << 5 | index << 7;
    if (at < MAX_CANDIDATES)
        return;
    b.slots[a].overlaps = 1;
    if (kind == SLOT)
        b.slots[index].overlaps = 1;
}

// Returns 1 if an object that is no body, of environment `env`, is an obstacle within reach of slot
// a. Some are larger than a disc of their size: 1.5 is beyond crates' corners.
HD int is_near(const ObjectsParams& o, const Bodies& b, int env, int a, int k, float reach) {
    Object object = objects_of(o)[env * o.n_objects + k];
    float apart = b.slots[a].extent + 1.5f * object.size + reach;
    return o.object_bodies[k] < 0 && is_obstacle(object) &&
           ABS(object.x - b.slots[a].hull.x) <= apart && ABS(object.y - b.slots[a].hull.y) <= apart;
}

// Returns 1 if two slots may touch while nothing moves further than `reach`.
HD int may_touch(const Bodies& b, int a, int c, float reach) {
    float apart = b.slots[a].extent + b.slots[c].extent + 2.f * reach;
    return ABS(b.slots[c].hull.x - b.slots[a].hull.x) <= apart &&
           ABS(b.slots[c].hull.y - b.slots[a].hull.y) <= apart;
}

// Leaves out slots that rest and that nothing may touch in this step: which nothing that moves may
// reach, nor what that may push.
template <class Group>
HD void leave_out_sleepers(const Group& group, Bodies& b, int n_slots, float reach) {
    unsigned int awake = 0;  // a bit for each slot
    for (int i = group.rank; i < n_slots; i += Group::SIZE)
        awake |= (b.slots[i].speed > 0.f ? 1u : 0u) << i;
    awake = reduce_or(group, awake);
    for (unsigned int woken = awake; woken; awake |= woken) {
        unsigned int wakes = 0;
        for (int i = group.rank; i < n_slots; i += Group::SIZE) {
            unsigned int left = b.slots[i].exists && !(awake >> i & 1) ? woken : 0u;
            for (; left; left &= left - 1u)
                if (may_touch(b, i, COUNT_BITS((left & (0u - left)) - 1u), reach))
                    wakes |= 1u << i;
        }
        woken = reduce_or(group, wakes);
    }
    each(group, 0, n_slots, [&](int i) { b.slots[i].exists &= awake >> i & 1; });
}

// Lists all pairs that may touch while nothing moves further than `reach`. Returns their number.
template <class Group>
HD int find_candidates(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int env,
                       float reach) {
    const SceneryParams& s = p.scenery;
    Walls walls = walls_of(s, layout_of(s, env, p.error_flag));
    int n_slots = n_slots_of(p), n = 0;
    for (int a = 0; a < n_slots; a++) {
        if (!b.slots[a].exists)
            continue;
        const Hull& hull = b.slots[a].hull;
        float apart = b.slots[a].extent + reach;
        int elevated = b.slots[a].elevated;
        for (int start = a + 1; start < n_slots; start += Group::SIZE) {
            int c = start + group.rank, has = c < n_slots;
            if (has)
                has = b.slots[c].exists &&
                      (b.slots[a].inv_mass > 0.f || b.slots[c].inv_mass > 0.f) &&
                      may_touch(b, a, c, reach) && !passes_slot(elevated, c, s.n_agents);
            add_candidate(group, b, has, a, SLOT, c, n);
        }
        if (b.slots[a].inv_mass == 0.f)
            continue;
        for (int start = walls.first_box; start < walls.end_box; start += Group::SIZE) {
            int i = start + group.rank, meets = 0;
            if (i < walls.end_box) {
                Float4 box = LOAD((const Float4*)s.boxes + i);
                meets = boxes_meet(hull.x, hull.y, 0.f, 0.f, box.x, box.y, box.z, box.w, apart);
            }
            unsigned int boxes = ballot(group, meets);
            for (int k = 0; boxes; k++, boxes >>= 1) {
                if (!(boxes & 1))
                    continue;
                int first = walls.first_wall + BOX_WALLS * (start - walls.first_box + k);
                int end = mini(first + BOX_WALLS, walls.end_wall);
                for (int j = first; j < end; j += Group::SIZE) {
                    int has = j + group.rank < end;
                    if (has) {
                        Float4 wall = LOAD((const Float4*)s.walls + j + group.rank);
                        has = boxes_meet(hull.x, hull.y, 0.f, 0.f, wall.x, wall.y, wall.z, wall.w,
                                         apart);
                    }
                    add_candidate(group, b, has, a, WALL, j + group.rank - walls.first_wall, n);
                }
            }
        }
        const ObjectsParams& o = p.objects;
        if (o.n_objects > o.n_bodies)
            for (int start = 0; start < o.n_objects; start += Group::SIZE) {
                int k = start + group.rank;
                int has = k < o.n_objects && is_near(o, b, env, a, k, reach);
                add_candidate(group, b, has, a, OBJECT, k, n);
            }
    }
    return mini(n, MAX_CANDIDATES);
}

// The second hull of a candidate, as it is, or as it was before the substep.
HD Hull other_hull(const PhysicsBodiesParams& p, const Bodies& b, int env, int candidate,
                   int is_before) {
    int kind = candidate >> 5 & 3, index = candidate >> 7;
    if (kind == SLOT)
        return is_before ? b.slots[index].before : b.slots[index].hull;
    const SceneryParams& s = p.scenery;
    if (kind == WALL) {
        int layout = layout_of(s, env, p.error_flag);
        return hull_of(LOAD((const Float4*)s.walls + s.wall_starts[layout] + index));
    }
    const ObjectsParams& o = p.objects;
    Object object = objects_of(o)[env * o.n_objects + index];
    return hull_at(object.x, object.y, object.angle, object.size,
                   half_width_of(o, index, object.size));
}

// Returns 1 if the centre of a hull that was at `old` has passed through a wall or a door.
HD int passes(const Hull& old, const Hull& now, const Hull& wall) {
    float ex = wall.cosine * wall.hx, ey = wall.sine * wall.hx;
    return wall.hy == 0.f && cuts(wall.x - ex, wall.y - ey, wall.x + ex, wall.y + ey, old.x, old.y,
                                  now.x - old.x, now.y - old.y);
}

// Marks the slots of a candidate that overlap more than they may, and more than before the substep.
// Returns 1 if there are any that have not been taken back yet.
HD int mark_overlap(const PhysicsBodiesParams& p, Bodies& b, int env, int candidate, const Touch& t,
                    const Hull& other) {
    int a = candidate & 31, kind = candidate >> 5 & 3, index = candidate >> 7;
    int is_fixed = b.slots[a].taken_back && (kind != SLOT || b.slots[index].taken_back);
    int is_through = kind != SLOT && passes(b.slots[a].before, b.slots[a].hull, other);
    float gap = gap_of(t);
    if (is_fixed || (gap >= -MAX_OVERLAP && !is_through))
        return 0;
    Hull old = other_hull(p, b, env, candidate, 1);
    if (!is_through && gap >= gap_of(touch(b.slots[a].before, old)) - 1e-6f)
        return 0;
    b.slots[a].overlaps = 1;
    if (kind == SLOT)
        b.slots[index].overlaps = 1;
    return 1;
}

// Numbers touches so that those with the same number share no slot that moves, and each comes after
// all earlier touches of its slots.
HD void number_levels(Bodies& b, int n_slots, int n_touches) {
    for (int i = 0; i < n_slots && n_touches; i++)
        b.slots[i].last = 0;
    b.n_levels = 0;
    for (int k = 0; k < n_touches; k++) {
        int a = b.touch_a[k], c = b.touch_b[k];
        int moves_a = b.slots[a].inv_mass > 0.f, moves_c = c >= 0 && b.slots[c].inv_mass > 0.f;
        int level = maxi(moves_a ? b.slots[a].last : 0, moves_c ? b.slots[c].last : 0) + 1;
        if (moves_a)
            b.slots[a].last = level;
        if (moves_c)
            b.slots[c].last = level;
        b.levels[k] = level;
        b.n_levels = maxi(b.n_levels, level);
    }
}

// Returns 1 if a candidate overlaps, beyond the slop, or has passed through a wall.
HD int is_bad(const Bodies& b, int candidate, const Touch& t, const Hull& other) {
    int a = candidate & 31, kind = candidate >> 5 & 3;
    return gap_of(t) < -SLOP || (kind != SLOT && passes(b.slots[a].before, b.slots[a].hull, other));
}

// Finds the candidates that are within reach, per slot, of touching. With `checks`, also marks
// those that overlap too much. Returns 1 if any do, else 0; without, 1 if any is_bad.
template <class Group>
HD int find_touches(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int env,
                    int n_candidates, float reach, int checks, int& n_touches) {
    int n = 0;
    unsigned int any = 0;
    for (int start = 0; start < n_candidates; start += Group::SIZE) {
        int has = start + group.rank < n_candidates, candidate = 0;
        Touch t;
        if (has) {
            candidate = b.candidates[start + group.rank];
            int a = candidate & 31, is_slot = (candidate >> 5 & 3) == SLOT;
            Hull other = other_hull(p, b, env, candidate, 0);
            t = touch(b.slots[a].hull, other);
            any |= checks ? mark_overlap(p, b, env, candidate, t, other)
                          : is_bad(b, candidate, t, other);
            has = gap_of(t) < (is_slot ? 2.f * reach : reach);
        }
        int at = append(group, has, n);
        if (at >= 0 && at < MAX_TOUCHES) {
            b.touch_a[at] = candidate & 31;
            b.touch_b[at] = (candidate >> 5 & 3) == SLOT ? candidate >> 7 : -1;
            b.touches[at] = t;
            b.impulses[at][0] = 0.f;
            b.impulses[at][1] = 0.f;
        }
    }
    n_touches = mini(n, MAX_TOUCHES);
    sync(group);
    if (group.rank == 0)
        number_levels(b, n_slots_of(p), n_touches);
    sync(group);
    return reduce_or(group, any) != 0;
}

// How much an impulse moves a slot. Agents give way to all else when overlaps end, so that bodies
// at rest, which friction holds, stay where they are.
HD float inverse_of(const Slot& slot, int is_agent, int is_shift) {
    return is_shift && is_agent ? LIGHT * slot.inv_mass : slot.inv_mass;
}

HD void push(const Slot& slot, Motion& motion, float inverse, float jx, float jy, float turn) {
    if (!(inverse > 0.f))
        return;
    motion.x += inverse * jx;
    motion.y += inverse * jy;
    motion.turn += slot.inv_inertia * turn;
}

// Solves a touch: changes its slots' motions, which last h seconds, by impulses along the normal,
// never below 0 in sum, after which no point overlaps, or more than SLOP if these are shifts. Two
// points are solved together, exactly.
RARE void solve_touch(Bodies& b, int k, int n_agents, float inv_h, int is_shift) {
    int a = b.touch_a[k], c = b.touch_b[k];
    const Touch& t = b.touches[k];
    Slot &slot = b.slots[a], &other = b.slots[maxi(c, 0)];  // without a slot c, unused
    Motion& m = is_shift ? slot.shift : slot.velocity;
    Motion& of_other = is_shift ? other.shift : other.velocity;
    float mass_a = inverse_of(slot, a < n_agents, is_shift), inertia_a = slot.inv_inertia;
    float mass_c = c < 0 ? 0.f : inverse_of(other, c < n_agents, is_shift);
    float inertia_c = c < 0 ? 0.f : other.inv_inertia, turn_c = c < 0 ? 0.f : of_other.turn;
    float x = (c < 0 ? 0.f : of_other.x) - m.x, y = (c < 0 ? 0.f : of_other.y) - m.y;
    float turn_a = inertia_a > 0.f ? m.turn : 0.f;  // a disc's turning moves no point of touch
    float along = t.nx * x + t.ny * y, both = mass_a + mass_c;
    float old[2] = {b.impulses[k][0], b.impulses[k][1]}, mass[2], target[2];
    float between =
        both + inertia_a * t.arms_a[0] * t.arms_a[1] + inertia_c * t.arms_b[0] * t.arms_b[1];
    for (int i = 0; i < 2; i++) {
        float gap = t.gaps[i];
        float room = is_shift ? maxf(gap + SLOP, -MAX_SHIFT) : maxf(gap, 0.f) * inv_h;
        mass[i] =
            both + inertia_a * t.arms_a[i] * t.arms_a[i] + inertia_c * t.arms_b[i] * t.arms_b[i];
        target[i] = along + turn_c * t.arms_b[i] - turn_a * t.arms_a[i] + room;
    }
    // without the impulses so far: mass x impulses + target >= 0
    float one = target[0] - mass[0] * old[0], two = target[1] - mass[1] * old[1];
    float first = 0.f, second = 0.f;
    if (old[0] == 0.f && old[1] == 0.f && one >= 0.f && (two >= 0.f || t.n == 1))
        return;  // so it takes none
    if (t.n == 2) {
        one -= between * old[1];
        two -= between * old[0];
        float determinant = mass[0] * mass[1] - between * between;
        float both_first = between * two - mass[1] * one;
        float both_second = between * one - mass[0] * two;
        float only_first = -one / mass[0], only_second = -two / mass[1];
        if (determinant > 1e-3f * mass[0] * mass[1] && both_first >= 0.f && both_second >= 0.f) {
            first = both_first / determinant;
            second = both_second / determinant;
        } else if (only_first >= 0.f && between * only_first + two >= 0.f) {
            first = only_first;
        } else if (only_second >= 0.f && between * only_second + one >= 0.f) {
            second = only_second;
        } else if (t.gaps[0] <= t.gaps[1]) {  // none, or nearly the same point
            first = maxf(only_first, 0.f);
        } else {
            second = maxf(only_second, 0.f);
        }
    } else {
        first = maxf(-one / mass[0], 0.f);
    }
    b.impulses[k][0] = first;
    b.impulses[k][1] = second;
    if (first > 0.f || second > 0.f) {
        slot.hit = 1;
        if (c >= 0)
            other.hit = 1;
    }
    float d1 = first - old[0], d2 = second - old[1], sum = d1 + d2;
    push(slot, m, mass_a, -sum * t.nx, -sum * t.ny, -(d1 * t.arms_a[0] + d2 * t.arms_a[1]));
    if (c >= 0)
        push(other, of_other, mass_c, sum * t.nx, sum * t.ny, d1 * t.arms_b[0] + d2 * t.arms_b[1]);
}

// Keeps what is held where it was grabbed, in its holder's frame, by at most `grip` newtons.
HD void solve_hold(Bodies& b, Slot& slot, float h, float grip) {
    if (slot.holder < 0)
        return;
    Slot& holder = b.slots[slot.holder];
    float* impulse = slot.hold;
    Motion &m = slot.velocity, &of_holder = holder.velocity;
    const Hull &agent = holder.hull, &body = slot.hull;
    float mass_a = holder.inv_mass, mass = slot.inv_mass, inertia = slot.inv_inertia;
    float rx = agent.cosine * slot.hold_x - agent.sine * slot.hold_y;
    float ry = agent.sine * slot.hold_x + agent.cosine * slot.hold_y;
    float rate = 0.2f / h;  // at which what is out of place comes back
    float off = wrap_degrees(slot.angle - holder.angle - slot.hold_turn) * RADIANS;
    float limit = grip * h, max_turn = limit * SQRT(mass / inertia);
    float turn = impulse[2] - (m.turn - of_holder.turn + rate * off) / inertia;
    turn = clamp(turn, -max_turn, max_turn);
    push(slot, m, mass, 0.f, 0.f, turn - impulse[2]);
    impulse[2] = turn;
    float vx = m.x - of_holder.x + of_holder.turn * ry + rate * (body.x - agent.x - rx);
    float vy = m.y - of_holder.y - of_holder.turn * rx + rate * (body.y - agent.y - ry);
    float jx = impulse[0] - vx / (mass_a + mass), jy = impulse[1] - vy / (mass_a + mass);
    float size = SQRT(jx * jx + jy * jy), scale = size > limit ? limit / size : 1.f;
    jx *= scale;
    jy *= scale;
    push(slot, m, mass, jx - impulse[0], jy - impulse[1], 0.f);
    push(holder, of_holder, mass_a, impulse[0] - jx, impulse[1] - jy, 0.f);
    impulse[0] = jx;
    impulse[1] = jy;
}

// The floor's impulse on a slot: it brings the slot to the velocity that it wishes, which of a body
// is none, by at most so much force, and for bodies torque.
HD void solve_drag(Slot& slot, float h) {
    if (!(slot.inv_mass > 0.f) || !(slot.drag > 0.f))
        return;
    Motion& m = slot.velocity;
    float limit = slot.drag * h, mass = slot.inv_mass, inertia = slot.inv_inertia;
    float jx = slot.drag_x + (slot.wish_x - m.x) / mass;
    float jy = slot.drag_y + (slot.wish_y - m.y) / mass;
    float size = SQRT(jx * jx + jy * jy);
    if (size > limit) {
        jx *= limit / size;
        jy *= limit / size;
        m.x += mass * (jx - slot.drag_x);
        m.y += mass * (jy - slot.drag_y);
    } else {
        m.x = slot.wish_x;
        m.y = slot.wish_y;
    }
    slot.drag_x = jx;
    slot.drag_y = jy;
    if (!(inertia > 0.f))
        return;
    float torque = limit * ARM * SQRT(mass / inertia);
    float turn = slot.drag_turn - m.turn / inertia;
    if (ABS(turn) > torque) {
        turn = signed_as(torque, turn);
        m.turn += inertia * (turn - slot.drag_turn);
    } else {
        m.turn = 0.f;
    }
    slot.drag_turn = turn;
}

HD void begin_substep(Slot& slot) {
    slot.drag_x = slot.drag_y = slot.drag_turn = 0.f;
    slot.before = slot.hull;
    slot.angle_before = slot.angle;
    slot.overlaps = slot.taken_back = 0;
    for (int k = 0; k < 3; k++)
        slot.hold[k] = 0.f;
}

// Moves a slot for h seconds, or for less: no point of it moves faster than `limit`.
HD void displace(Slot& slot, const Motion& m, float h, float limit) {
    if (!(slot.inv_mass > 0.f))
        return;
    float turn = slot.inv_inertia > 0.f ? m.turn : 0.f;
    float speed = speed_of(m.x, m.y, turn, slot.extent);
    if (speed > limit)
        h *= limit / speed;
    slot.hull.x += h * m.x;
    slot.hull.y += h * m.y;
    if (m.turn != 0.f) {
        slot.angle += h * (m.turn * DEGREES);
        sincos_degrees(slot.angle, slot.hull.sine, slot.hull.cosine);
    }
}

// Puts a slot back to where it was before the substep, at rest. An agent still turns.
HD void take_back(Slot& slot, int is_agent) {
    if (!slot.overlaps || slot.taken_back)
        return;
    slot.taken_back = 1;
    slot.hit = 1;
    slot.hull.x = slot.before.x;
    slot.hull.y = slot.before.y;
    slot.velocity.x = slot.velocity.y = 0.f;
    if (is_agent)
        return;
    slot.hull = slot.before;
    slot.angle = slot.angle_before;
    slot.velocity.turn = 0.f;
}

HD void add_load(Slot& slot) {
    slot.load += SQRT(slot.hold[0] * slot.hold[0] + slot.hold[1] * slot.hold[1]);
    slot.load_turn += ABS(slot.hold[2]);
}

template <class Group>
HD void solve_touches(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int n_touches,
                      float inv_h, int is_shift) {
    for (int level = 1; level <= b.n_levels; level++) {
        for (int k = group.rank; k < n_touches; k += Group::SIZE)
            if (b.levels[k] == level)
                solve_touch(b, k, p.scenery.n_agents, inv_h, is_shift);
        sync(group);
    }
}

// Changes velocities for a substep of h seconds. `holds`: 0 if no agent holds anything.
template <class Group>
HD void solve(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int n_touches, float h,
              int holds) {
    int n_agents = p.scenery.n_agents, n_slots = n_slots_of(p);
    int n_iterations = n_touches || holds ? ITERATIONS : 1;  // one has the floor's impulses
    for (int i = 0; i < n_iterations; i++) {
        each(group, 0, n_agents, [&](int a) { solve_drag(b.slots[a], h); });
        if (holds) {
            if (group.rank == 0)
                for (int k = 0; k < p.objects.n_bodies; k++)
                    solve_hold(b, b.slots[n_agents + k], h, p.grip);
            sync(group);
        }
        solve_touches(p, group, b, n_touches, 1.f / h, 0);
        each(group, n_agents, n_slots, [&](int k) { solve_drag(b.slots[k], h); });
    }
    for (int k = n_agents + group.rank; k < n_slots && holds; k += Group::SIZE)
        add_load(b.slots[k]);
}

template <class Group>
HD void end_overlaps(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int n_touches) {
    int n_slots = n_slots_of(p);
    each(group, 0, n_slots,
         [&](int i) { b.slots[i].shift.x = b.slots[i].shift.y = b.slots[i].shift.turn = 0.f; });
    for (int i = 0; i < ITERATIONS; i++)
        solve_touches(p, group, b, n_touches, 1.f, 1);
    each(group, 0, n_slots, [&](int i) { displace(b.slots[i], b.slots[i].shift, 1.f, MAX_SHIFT); });
}

// Writes what an agent did, and the fraction of what it wished, as `physics` does.
HD void end_agent(const PhysicsBodiesParams& p, const Bodies& b, int env, int a) {
    const Slot& slot = b.slots[a];
    int i = env * p.scenery.n_agents + a;
    float *position = p.positions + 2 * i, *velocity = p.velocity + 2 * i;
    float wish_x = slot.wish_x * p.seconds, wish_y = slot.wish_y * p.seconds;
    float wish2 = wish_x * wish_x + wish_y * wish_y;
    float moved = (slot.hull.x - position[0]) * wish_x + (slot.hull.y - position[1]) * wish_y;
    p.progress[i] = slot.hit && wish2 > 0.f ? clamp(moved / wish2, 0.f, SHORTENING) : 1.f;
    position[0] = slot.hull.x;
    position[1] = slot.hull.y;
    velocity[0] = slot.velocity.x;
    velocity[1] = slot.velocity.y;
    p.angles[i] = wrap_degrees(slot.angle);
    flag_nonfinite(p.error_flag, env, position[0], position[1], p.angles[i]);
}

// Writes how a body moved. Its holder lets go if it had to use all its force, on average.
HD void end_body(const PhysicsBodiesParams& p, const Bodies& b, int env, int k) {
    const ObjectsParams& o = p.objects;
    const Slot& slot = b.slots[p.scenery.n_agents + k];
    Body& body = bodies_of(o)[env * o.n_bodies + k];
    float limit = 0.99f * p.grip * p.seconds;
    float arm = SQRT(slot.inv_mass / slot.inv_inertia);
    int slips = slot.load >= limit || slot.load_turn >= limit * arm;
    body.holder = slips ? -1 : slot.holder;
    if (!(slot.inv_mass > 0.f))
        return;
    Object& object = objects_of(o)[env * o.n_objects + object_of_body(o, k)];
    object.x = slot.hull.x;
    object.y = slot.hull.y;
    if (slot.angle != object.angle)
        object.angle = wrap_degrees(slot.angle);
    body.vx = slot.velocity.x;
    body.vy = slot.velocity.y;
    body.turning = slot.velocity.turn * DEGREES;
}

template <class Group>
HD void move_bodies(const PhysicsBodiesParams& p, const Group& group, Bodies& b, int env) {
    int n_agents = p.scenery.n_agents, n_slots = n_slots_of(p);
    each(group, 0, n_slots, [&](int i) {
        if (i < n_agents)
            begin_agent(p, b, env, i);
        else
            begin_body(p, b, env, i - n_agents);
        b.slots[i].hit = b.slots[i].overlaps = b.slots[i].elevated = 0;
        b.slots[i].before = b.slots[i].hull;
    });
    if (p.objects.elevated) {
        int* elevated = p.objects.elevated + env * n_agents;
        each(group, 0, n_agents, [&](int a) {
            elevated[a] = elevation_of(p, b, env, a);
            b.slots[a].elevated = mini(elevated[a], 1);
        });
    }
    unsigned int any = 0;
    for (int k = group.rank; k < n_slots - n_agents; k += Group::SIZE) {
        begin_hold(p, b, env, k);
        any |= b.slots[n_agents + k].holder >= 0;
    }
    int holds = reduce_or(group, any) != 0;
    sync(group);
    each(group, 0, n_slots, [&](int i) { b.slots[i].speed = top_speed(b, i, n_agents); });
    float top = 0.f;
    for (int i = 0; i < n_slots; i++)
        top = maxf(top, b.slots[i].speed);
    if (top == 0.f) {  // all rest
        for (int a = group.rank; a < n_agents; a += Group::SIZE)
            p.progress[env * n_agents + a] = 1.f;
        for (int k = group.rank; k < n_slots - n_agents; k += Group::SIZE)
            bodies_of(p.objects)[env * p.objects.n_bodies + k].holder =
                b.slots[n_agents + k].holder;
        return;
    }
    float limit = top + MIN_LIMIT, h = p.seconds * (1.f / SUBSTEPS);
    float reach = limit * h + MAX_SHIFT;
    leave_out_sleepers(group, b, n_slots, SUBSTEPS * reach);
    int n_candidates = find_candidates(p, group, b, env, SUBSTEPS * reach), n_touches;
    sync(group);
    each(group, 0, n_slots, [&](int i) {
        if (b.slots[i].overlaps) {  // in a pair that is not listed
            b.slots[i].inv_mass = b.slots[i].inv_inertia = 0.f;
            b.slots[i].velocity.x = b.slots[i].velocity.y = 0.f;
        }
    });
    for (int substep = 0, checks = 0;;) {
        int is_bad = find_touches(p, group, b, env, n_candidates, reach, checks, n_touches);
        if (checks && is_bad) {  // shifts were not enough
            each(group, 0, n_slots, [&](int i) { take_back(b.slots[i], i < n_agents); });
            continue;
        }
        if (is_bad && !checks && substep > 0) {
            end_overlaps(p, group, b, n_touches);
            checks = 1;
            continue;
        }
        if (substep == SUBSTEPS)
            break;
        substep++;
        checks = 0;
        each(group, 0, n_slots, [&](int i) { begin_substep(b.slots[i]); });
        solve(p, group, b, n_touches, h, holds);
        each(group, 0, n_slots,
             [&](int i) { displace(b.slots[i], b.slots[i].velocity, h, limit); });
    }
    for (int i = group.rank; i < n_slots; i += Group::SIZE)
        if (i < n_agents)
            end_agent(p, b, env, i);
        else
            end_body(p, b, env, i - n_agents);
}
