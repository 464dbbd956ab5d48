// Objects: things in an environment that agents see, bump into and carry.
//
// N environments, O objects per environment, L lines of one environment's objects, P colours.
#pragma once
#include "common/scenery.h"

// An object, in 32 bytes that are read at once. Python's tensors of objects are views of its
// fields.
struct ALIGNED Object {
    float x, y;             // metres; of a carried object, its carrier's
    float angle;            // degrees
    float size;             // metres: radius, or half the length of a side
    int carrier;            // the agent that carries it; -1: none
    int colour;             // index into the palette
    unsigned char visible;  // 0: as if it were not there
    unsigned char solid;    // 1: stops agents and lines of sight
    unsigned char open;     // 1: as if it were not there
    unsigned char unused[5];
};
static_assert(sizeof(Object) == OBJECT_BYTES, "Python views its fields");

// What an object has that can be pushed, in 48 bytes.
struct ALIGNED Body {
    float vx, vy;                     // m/s
    float turning;                    // deg/s
    float mass;                       // kg
    float friction;                   // coefficient, with the floor
    int holder;                       // the agent that holds it; -1: none
    float hold_x, hold_y, hold_turn;  // its pose in the holder's frame
    int owner;                        // the team that locked it; -1: none
    unsigned char movable;            // 0: as if its mass were infinite
    unsigned char locked;             // 1: likewise
    unsigned char grabbed;            // 1: since the last step, so its pose is to be stored
    unsigned char unused[5];
};
static_assert(sizeof(Body) == BODY_BYTES, "Python views its fields");

struct ObjectsParams {
    const int* shapes;       // (O) DISC, CRATE, DOOR or RAMP
    const int* line_starts;  // (O + 1) first line of each object
    const int* line_object;  // (L) the object of each line
    const float* palette;    // (P, 3) linear light
    const float* extents;    // (D, 4) min x, min y, max x, max y of each layout's walls
    float* objects;          // (N, O) records of the struct Object
    float* lines;            // (N, L, 4) out; an object that is not there has lines of 0 m
    float* texels;           // (N, O, 4) out: red, green, blue, light
    int n_objects;           // 0: there are none
    int n_lines;
    int n_colours;
    int lit;                   // 1: the layout's lights fall on them, else each has full light
    const float* ends;         // (L, 4) of each line, of an object of size 1 at the origin
    float* bodies;             // (N, B) records of the struct Body
    const int* body_objects;   // (B) the object that each body is
    const int* object_bodies;  // (O) the body that each object is; -1: none
    int n_bodies;              // B
    // (N, A) in and out. Above 0: steps in which the agent still passes bodies. Below: -1 - body,
    // of the ramp that it drives up, and passes. Null: there are no ramps.
    int* elevated;
};

HD Object* objects_of(const ObjectsParams& o) { return (Object*)o.objects; }

HD Body* bodies_of(const ObjectsParams& o) { return (Body*)o.bodies; }

HD Object* objects_of(const ObjectsParams& o, int env) {
    return objects_of(o) + (long long)env * o.n_objects;
}

HD Body* bodies_of(const ObjectsParams& o, int env) {
    return bodies_of(o) + (long long)env * o.n_bodies;
}

// Stops a body that is put elsewhere, and frees it.
HD void rest(Body& body) {
    body.vx = body.vy = body.turning = 0.f;
    body.holder = body.owner = -1;
    body.locked = 0;
}

// The object that an environment's body k is.
HD int object_of_body(const ObjectsParams& o, int k) {
    return within(o.body_objects[k], o.n_objects - 1);
}

// The object of an environment's line l; the first if its number is of none.
HD int object_of(const ObjectsParams& o, int l) {
    int k = o.line_object[l];
    return (unsigned int)k < (unsigned int)o.n_objects ? k : 0;
}

HD int is_there(const Object& object) { return object.visible && !object.open; }

HD int is_obstacle(const Object& object) {
    return object.solid && is_there(object) && object.carrier < 0;
}

// A line with these ends at a size of 1, of an object of this size at a pose. Written with sums
// alone: GCC 12, when it vectorises a sum beside a difference, fuses them with the products in
// spite of -ffp-contract=off.
HD Float4 line_at(const Float4& ends, float size, const Pose& pose) {
    float ax = ends.x * size, ay = ends.y * size, bx = ends.z * size, by = ends.w * size;
    float minus_sine = -pose.sine;
    return {pose.x + (pose.cosine * ax + minus_sine * ay),
            pose.y + (pose.sine * ax + pose.cosine * ay),
            pose.x + (pose.cosine * bx + minus_sine * by),
            pose.y + (pose.sine * bx + pose.cosine * by)};
}

HD Range lines_of(const ObjectsParams& o, int k) { return range_of(o.line_starts, k, o.n_lines); }

// Where the first line of a rectangle begins, in its sizes: half its width to the right.
HD float first_y_of(const ObjectsParams& o, int k) {
    return LOAD((const Float4*)o.ends + mini(lines_of(o, k).first, o.n_lines - 1)).y;
}

// Half the diagonal of object k, if it is a body, since bodies never overlap; else its size.
HD float radius_of(const ObjectsParams& o, int k, float size) {
    if (o.n_bodies == 0 || o.object_bodies[k] < 0 || o.shapes[k] == DISC)
        return size;
    float half = first_y_of(o, k);
    return size * SQRT(1.f + half * half);
}

// Line l of an environment's objects, one of this object at a pose.
HD Float4 line_of(const ObjectsParams& o, int l, const Object& object, const Pose& pose) {
    return line_at(LOAD((const Float4*)o.ends + l), object.size, pose);
}

// Returns 1 if a disc of this radius touches no obstacle of an environment. Crates and doors count
// as discs of their size.
HD int is_clear(const ObjectsParams& o, int env, float x, float y, float radius) {
    for (int i = env * o.n_objects; i < (env + 1) * o.n_objects; i++) {
        Object object = objects_of(o)[i];
        float apart = radius + radius_of(o, i % o.n_objects, object.size);
        float dx = x - object.x, dy = y - object.y;
        if (is_obstacle(object) && dx * dx + dy * dy < apart * apart)
            return 0;
    }
    return 1;
}
