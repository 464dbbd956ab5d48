// The parameters of each launch, passed by value. launch.py packs them by field name, and the
// layout in memory is read from here, so declare one field per line. A null pointer means that an
// output is not wanted or that an input was not given.
//
// N environments, D layouts, A agents per environment, C cameras per agent, R rays per camera, P
// pixels per camera. W walls and T texels of all layouts together. B lanes.
#pragma once
#include "common/objects.h"

struct BakeParams {
    SceneryParams scenery;
    const int* texel_wall;   // (T) the wall that each texel lies on
    const int* wall_layout;  // (W) the layout that each wall belongs to
    int n_texels;
};

struct WorldParams {
    SceneryParams scenery;
    float* positions;  // (N, A, 2) metres
    float* angles;     // (N, A) degrees
    int* error_flag;   // (1) out: see common/errors.h
};

struct PhysicsParams : WorldParams {
    float* velocity;           // (N, A, 2) metres per second; as poses, updated in place
    float* angvelocity;        // (N, A) degrees per second
    float* progress;           // (N, A) out: fraction of the step that was free, in [0, 1]
    const long long* actions;  // (N, A) null: there are no discrete actions
    const float* controls;     // (N, A, n_moves) null: there are no continuous actions
    const float* moves;  // (n_moves, 3) added by an action: velocity ahead, velocity left, turning
    int n_moves;
    float retained;       // fraction of the old velocities that is left if there are actions
    float seconds;        // length of the step
    int threads_per_env;  // on the GPU: a power of two up to 32
    ObjectsParams objects;
};

struct PhysicsBodiesParams : PhysicsParams {
    float force;        // newtons, at most, of each agent
    float grip;         // newtons, at most, between an agent and what it holds
    int ramp_steps;     // for which an agent is elevated that has driven up a ramp
    int grab_elevated;  // 0: elevated agents hold nothing
};

struct UpdateAgentGeometryParams : WorldParams {
    int lit;  // 1: light the agents' texels too
};

struct RenderParams : WorldParams {
    const float* yaws;         // (C) degrees, added to the agent's angle
    const float* ray_lengths;  // (R) length of each ray per unit of depth
    int n_cameras;             // C
    int res;                   // R
    float half_width;          // tan(fov / 2): the edge of the screen at unit depth
    float edge;                // ray r looks along (1, edge - pitch r)
    float pitch;
    float centre;  // a point (x, y) lies at ray centre - scale y / x
    float scale;
    float near;        // depth below which everything on the screen is within the radius
    int* indices;      // (N, A, C, R) out: line hit, agents' lines first; -1: none
    float* locations;  // (N, A, C, R) out: fraction along the line
    float* dots;       // (N, A, C, R) out: cosine between ray and line
    float* distances;  // (N, A, C, R) out: metres
    float* screen;     // (N, A, C, R, 3) out
    int subsample;     // rays per pixel
    int n_pixels;      // P = R / subsample
    float inv_subsample;
    float inv_max_depth;       // per metre
    unsigned short* rgb;       // (N, A, C, 3, P) out: fp16
    unsigned short* depth;     // (N, A, C, P) out: fp16, 1 at the radius, falling to 0
    int* centre_line;          // (N, A, C) out: line at the centre of the screen
    int* agent_ray;            // (N, A, C) out: ray closest to the centre that hits an agent, or -1
    const float* velocity;     // (N, A, 2) for imu
    const float* angvelocity;  // (N, A) for imu
    unsigned short* imu;       // (N, A, 3) out: fp16
    unsigned int* seen;        // (N, A, n_words) in and out: a bit per static texel
    const unsigned char* clear_mask;  // (N, A) 1: clear seen first
    int* newly_seen;                  // (N, A) out: texels newly marked in seen
    const unsigned char* only;        // (N, A) 1: is rendered; null: all are
    int n_words;
    ObjectsParams objects;
};

struct DrawParams : WorldParams {
    const unsigned char* mask;  // what is put elsewhere: (N, A) agents or (N, O) objects
    const float* points;        // (D, n_points, 2) metres
    int* counts;        // as mask, in and out: numbers drawn so far, the generator's counter
    unsigned int key0;  // the seed
    unsigned int key1;
    int n_points;
    ObjectsParams objects;
};

struct SpawnParams : DrawParams {
    float* velocity;        // (N, A, 2) as poses, out where mask
    float* angvelocity;     // (N, A)
    int* point_index;       // (N, A) out where mask: the layout's point
    const int* cumulative;  // (D) cumulative weights of the layouts; null: all are as likely
    int resample;           // 1: an environment moves to a random layout if all its agents respawn
    int per_warp;           // environments for which a warp of `spawn_objects` looks
};

struct UpdateObjectsParams : WorldParams {
    ObjectsParams objects;
};

struct PlaceObjectsParams : DrawParams {
    float apart;  // metres, at least, between what is placed and agents and other objects
};

struct ScanParams : WorldParams {
    float* ranges;  // (N, A, R) out: metres; inf beyond range_max, -inf below range_min
    int n_rays;     // R
    float pitch;    // degrees from one ray to the next, counter-clockwise
    float range_min;
    float range_max;
};

struct UniformParams {
    const int* counts;          // (B) numbers drawn so far, the generator's counter
    const unsigned char* mask;  // (B) lanes that draw; rows of out of the others stay as they are
    float* out;                 // (B, 4) uniform in [0, 1)
    unsigned int key0;          // the seed
    unsigned int key1;
    int n_lanes;    // B
    int n_threads;  // CPU threads
};
