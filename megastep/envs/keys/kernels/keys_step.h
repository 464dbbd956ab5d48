// One step of Keys, before it is rendered. Where an episode starts, puts agent, keys, goal and
// doors where one of the layout's episodes has them. The agent picks up keys and opens doors of
// their colours by touching them.
#pragma once
#include "common/objects.h"
#include "common/philox.h"
#include "common/step.h"

constexpr int OPEN = -1;  // the state of a doorway without a door

// N environments of one agent, D layouts, M episodes per layout, C colours, K doorways. Objects are
// C keys, the goal, then K doors. Positions are written where an episode starts. Metrics: success,
// doors opened, keys wasted.
struct KeysStepParams : DrawnGameParams {
    ObjectsParams objects;
    const float* starts;       // (D, M, 2) metres
    const float* keys;         // (D, M, C, 2) metres, NaN: no such key
    const float* goals;        // (D, M, 2) metres
    const int* doors;          // (D, M, K) OPEN, a colour, or C, which stays locked
    const float* doorways;     // (D, K, 4) x, y, degrees, half the length
    int* opened;               // (N) in and out: doors opened in this episode
    unsigned short* keys_obs;  // (N, C) fp16: 1 for each key that the agent carries
    float* privileged;         // (N, 2 C + 3) for a critic; null: none
    int n_episodes;            // M
    int n_colours;             // C
    int n_doorways;            // K
    int limit;                 // steps per episode
    float reach;               // metres between surfaces at which an agent touches an object
    const float* key_reward;   // (), for a key that is picked up
    const float* door_reward;  // (), for a door that is opened
};

// Returns 1 if an agent at (x, y) touches an object that is there and not carried.
HD int touches(const KeysStepParams& p, const Object& object, float x, float y, int is_door) {
    if (!is_there(object) || object.carrier >= 0)
        return 0;
    float dx = x - object.x, dy = y - object.y, reach = p.scenery.radius + p.reach;
    if (!is_door) {
        reach += object.size;
        return dx * dx + dy * dy <= reach * reach;
    }
    Pose pose = pose_at(object.x, object.y, object.angle);
    float along = ABS(pose.cosine * dx + pose.sine * dy);
    float aside = pose.cosine * dy - pose.sine * dx;
    along = maxf(along - object.size, 0.f);
    return along * along + aside * aside <= reach * reach;
}

HD void put(Object& object, float x, float y, int colour, int visible) {
    object.x = visible ? x : 0.f;
    object.y = visible ? y : 0.f;
    object.colour = colour;
    object.visible = (unsigned char)visible;
    object.open = 0;
    object.carrier = -1;
}

HD void start_episode(const KeysStepParams& p, int env, int layout) {
    Philox bits = next_draw(p.n_draws, env, p.key0, p.key1);
    int drawn = below(bits.a, p.n_episodes), n = p.n_colours;
    long long row = (long long)layout * p.n_episodes + drawn;
    Object* things = objects_of(p.objects, env);
    p.positions[2 * env] = p.starts[2 * row];
    p.positions[2 * env + 1] = p.starts[2 * row + 1];
    for (int k = 0; k < n; k++) {
        const float* at = p.keys + 2 * (row * n + k);
        put(things[k], at[0], at[1], k, is_finite(at[0]));
    }
    put(things[n], p.goals[2 * row], p.goals[2 * row + 1], n + 1, 1);
    for (int k = 0; k < p.n_doorways; k++) {
        const float* doorway = p.doorways + 4 * ((long long)layout * p.n_doorways + k);
        Object& door = things[n + 1 + k];
        int state = p.doors[row * p.n_doorways + k];
        put(door, doorway[0], doorway[1], state < 0 ? n : state, state != OPEN);
        door.angle = doorway[2];
        door.size = doorway[3];
    }
}

// Writes where keys and goal are in the agent's frame, in tens of metres, and the fraction of the
// steps that is left. Keys that do not lie about are at 0. Written with sums alone, which compilers
// do not fuse.
HD void write_privileged(const KeysStepParams& p, int env, int age) {
    const Object* things = objects_of(p.objects, env);
    Pose pose = pose_at(p.positions[2 * env], p.positions[2 * env + 1], p.angles[env]);
    float minus_sine = -pose.sine;
    float* out = p.privileged + (2 * p.n_colours + 3) * (long long)env;
    for (int k = 0; k <= p.n_colours; k++) {
        int lies = is_there(things[k]) && things[k].carrier < 0;
        float dx = things[k].x - pose.x, dy = things[k].y - pose.y;
        out[2 * k] = lies ? 0.1f * (pose.cosine * dx + pose.sine * dy) : 0.f;
        out[2 * k + 1] = lies ? 0.1f * (pose.cosine * dy + minus_sine * dx) : 0.f;
    }
    out[2 * p.n_colours + 2] = (float)(p.limit - age) / (float)p.limit;
}

HD void keys_env(const KeysStepParams& p, int env) {
    if (!takes_part(p, env))
        return;
    int reset = begins(p, env), n = p.n_colours, success = 0;
    Object* things = objects_of(p.objects, env);
    if (reset)
        start_episode(p, env, layout_of(p.scenery, env, p.error_flag));
    float x = p.positions[2 * env], y = p.positions[2 * env + 1], reward = 0.f;
    flag_nonfinite(p.error_flag, env, x, y, p.angles[env]);
    int opened = reset ? 0 : p.opened[env];
    if (!reset) {
        for (int k = 0; k < n; k++)
            if (touches(p, things[k], x, y, 0)) {
                things[k].carrier = 0;
                reward += *p.key_reward;
            }
        for (int k = n + 1; k < n + 1 + p.n_doorways; k++) {
            int colour = things[k].colour;
            if (colour < 0 || colour >= n || things[colour].carrier != 0 ||
                !touches(p, things[k], x, y, 1))
                continue;
            things[k].open = 1;
            things[colour].visible = 0;
            things[colour].carrier = -1;
            reward += *p.door_reward;
            opened++;
        }
        success = touches(p, things[n], x, y, 0);
        reward += (float)success;
    }
    int age = reset ? 0 : p.ages[env] + 1, ends = !reset && (success || age >= p.limit), n_held = 0;
    for (int k = 0; k < n; k++) {
        int held = things[k].visible && things[k].carrier == 0;
        n_held += held;
        p.keys_obs[n * (long long)env + k] = HALF_BITS((float)held);
    }
    p.opened[env] = opened;
    write_outcome(p, env, reward, reset, age, ends, success);
    long long rows = p.scenery.n_envs;
    p.metrics[env] = ends && success ? 1.f : 0.f;
    p.metrics[rows + env] = ends ? (float)opened : 0.f;
    p.metrics[2 * rows + env] = ends ? (float)n_held : 0.f;
    if (p.privileged)
        write_privileged(p, env, age);
}

EACH(keys_step, KeysStepParams, p.scenery.n_envs, p.scenery.n_threads, keys_env(p, i))
