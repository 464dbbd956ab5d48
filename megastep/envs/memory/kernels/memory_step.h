// One step of Memory, before it is rendered. Where an episode starts, puts objects where one of the
// layout's arrangements has them. Rewards an agent that touches the object to find, and draws the
// next.
#pragma once
#include "common/objects.h"
#include "common/philox.h"
#include "common/step.h"

constexpr int N_GOAL = 4;  // numbers that a critic sees of the object to find

// N environments of one agent, D layouts, O objects. Metric: objects found.
struct MemoryStepParams : DrawnGameParams {
    ObjectsParams objects;
    const float* arrangements;  // (D, n_arrangements, O, 2) metres: where objects may lie
    int* cue;                   // (N) in and out, as the next: the object to find
    int* found;                 // (N) objects found in this episode
    unsigned short* cue_obs;    // (N, 3) fp16: the colour of the object to find
    float* goal;                // (N, N_GOAL) for a critic, as the next; null: neither
    float* places;              // (N, O, 2) tens of metres ahead and to the left of the agent
    int n_arrangements;         // per layout
    int limit;                  // steps per episode
    float reach;                // metres between surfaces at which an agent touches an object
};

HD int touches(const MemoryStepParams& p, int env, int k) {
    Object object = objects_of(p.objects)[env * p.objects.n_objects + k];
    float dx = p.positions[2 * env] - object.x, dy = p.positions[2 * env + 1] - object.y;
    float reach = p.scenery.radius + object.size + p.reach;
    return dx * dx + dy * dy <= reach * reach;
}

HD void arrange(const MemoryStepParams& p, int env, int layout, int arrangement) {
    int n = p.objects.n_objects;
    const float* at = p.arrangements + 2 * n * (layout * (long long)p.n_arrangements + arrangement);
    for (int k = 0; k < n; k++) {
        Object& object = objects_of(p.objects)[env * n + k];
        object.x = at[2 * k];
        object.y = at[2 * k + 1];
        object.visible = 1;
    }
}

// The first object to find: any that the agent does not touch, or any if it touches all.
HD int first_cue(const MemoryStepParams& p, int env, unsigned int bits) {
    int n = p.objects.n_objects, n_apart = 0;
    for (int k = 0; k < n; k++)
        n_apart += !touches(p, env, k);
    int index = below(bits, n_apart ? n_apart : n), cue = 0;
    while (n_apart && touches(p, env, cue))
        cue++;
    for (; index > 0; index--) {
        cue++;
        while (n_apart && touches(p, env, cue))
            cue++;
    }
    return cue;
}

// The next object to find: any but the one that was found.
HD int next_cue(const MemoryStepParams& p, int cue, unsigned int bits) {
    int index = below(bits, p.objects.n_objects - 1);
    return index + (index >= cue);
}

// Writes where the object to find and all objects are, in the agent's frame, for a critic. Written
// with sums alone, which compilers do not fuse.
HD void write_privileged(const MemoryStepParams& p, int env, int cue, int age) {
    int n = p.objects.n_objects;
    const Object* objects = objects_of(p.objects) + env * n;
    Pose pose = pose_at(p.positions[2 * env], p.positions[2 * env + 1], p.angles[env]);
    float minus_sine = -pose.sine;
    float* places = p.places + 2 * n * (long long)env;
    for (int k = 0; k < n; k++) {
        float dx = objects[k].x - pose.x, dy = objects[k].y - pose.y;
        places[2 * k] = 0.1f * (pose.cosine * dx + pose.sine * dy);
        places[2 * k + 1] = 0.1f * (pose.cosine * dy + minus_sine * dx);
    }
    float ahead = places[2 * cue], left = places[2 * cue + 1];
    float* goal = p.goal + N_GOAL * (long long)env;
    goal[0] = ahead;
    goal[1] = left;
    goal[2] = SQRT(ahead * ahead + left * left);
    goal[3] = (float)(p.limit - age) / (float)p.limit;
}

HD void memory_env(const MemoryStepParams& p, int env) {
    if (!takes_part(p, env))
        return;
    int reset = begins(p, env), cue = p.cue[env], hit = 0;
    flag_nonfinite(p.error_flag, env, p.positions[2 * env], p.positions[2 * env + 1],
                   p.angles[env]);
    if (!reset) {
        cue = checked(cue, p.objects.n_objects, p.error_flag, env, BAD_GOAL);
        hit = touches(p, env, cue);
    }
    if (reset || hit) {
        Philox bits = next_draw(p.n_draws, env, p.key0, p.key1);
        if (reset)
            arrange(p, env, layout_of(p.scenery, env, p.error_flag),
                    below(bits.b, p.n_arrangements));
        cue = reset ? first_cue(p, env, bits.a) : next_cue(p, cue, bits.a);
    }
    int age = reset ? 0 : p.ages[env] + 1, ends = !reset && age >= p.limit;
    int found = reset ? 0 : p.found[env] + hit;
    p.cue[env] = cue;
    p.found[env] = found;
    write_outcome(p, env, (float)hit, reset, age, ends, 0);
    p.metrics[env] = ends ? (float)found : 0.f;
    int colour = objects_of(p.objects)[env * p.objects.n_objects + cue].colour;
    colour = (unsigned int)colour < (unsigned int)p.objects.n_colours ? colour : 0;
    for (int c = 0; c < 3; c++)
        p.cue_obs[3 * (long long)env + c] = HALF_BITS(p.objects.palette[3 * colour + c]);
    if (p.goal)
        write_privileged(p, env, cue, age);
}

EACH(memory_step, MemoryStepParams, p.scenery.n_envs, p.scenery.n_threads, memory_env(p, i))
