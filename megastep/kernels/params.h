// What each launch is given, by value. compile.py reads these structs, one field per line, and
// builds their ctypes twins, so the layout in memory has one home. A null pointer: this output is
// not wanted, or this input not given.
//
// N environments, D layouts, A agents per environment, M lines of the agent model, K texels of one
// environment's agents, C cameras per agent, R rays per camera, P pixels per camera, W walls, T
// texels and l lights of all layouts.
#pragma once

constexpr int BOX_WALLS = 32;  // walls of a layout that share a bounding box

// On the GPU, render keeps one per pixel of each warp's screen in dynamic shared memory.
struct alignas(8) NearestLine {
    float inverse;  // per metre of depth
    int line;       // -1: none
};

struct SceneryParams {
    const float* walls;           // (W, 4) ax ay bx by in metres: one layout after the other
    const int* wall_starts;       // (D + 1) first wall of each layout
    const int* texel_starts;      // (W + 1) first texel of each wall
    const float* boxes;           // (., 4) min x, min y, max x, max y of each 32 walls of a layout
    const int* box_starts;        // (D + 1) first box of each layout
    float* texels;                // (T, 4) red, green, blue, light of each static texel
    const float* lights;          // (l, 3) x, y, intensity
    const int* light_starts;      // (D + 1) first light of each layout
    int* layout;                  // (N) the layout that each environment shows
    const float* model;           // (M, 4) the agent model about its own origin, in metres
    const int* model_texels;      // (A M + 1) first of the K texels of each agent line
    const float* agent_textures;  // (D, K, 3)
    float* agent_lines;           // (N, A M, 4) the agents' lines as last updated
    float* agent_light;           // (N, K) light on the agents' texels as last updated
    int n_envs;
    int n_layouts;
    int n_agents;
    int n_model;
    int n_agent_texels;  // K
    int n_threads;       // of the CPU
    float radius;        // metres: nearer walls are not seen; inflated, the disc that collides
    float reach;         // metres: at least what the model extends from its origin
};

struct BakeParams {
    SceneryParams scenery;
    const int* texel_wall;   // (T) the wall that each texel lies on
    const int* wall_layout;  // (W) the layout that each wall belongs to
    int n_texels;
};

struct PhysicsParams {
    SceneryParams scenery;
    float* positions;          // (N, A, 2) metres, updated in place
    float* angles;             // (N, A) degrees, updated in place
    float* velocity;           // (N, A, 2) metres per second
    float* angvelocity;        // (N, A) degrees per second
    float* progress;           // (N, A) out: fraction of the step that was free, in [0, 1]
    int* error_flag;           // (1) out: see errors.h
    const long long* actions;  // (N, A) null: velocities stay as they are
    const float* moves;        // (n_moves, 3) what an action adds: velocity ahead, left, turning
    int n_moves;
    float retained;       // fraction of the old velocities that stays when an action is taken
    float seconds;        // length of the step
    int threads_per_env;  // on the GPU: a power of two up to 32
};

struct UpdateAgentGeometryParams {
    SceneryParams scenery;
    const float* positions;  // (N, A, 2)
    const float* angles;     // (N, A)
    int* error_flag;         // (1) out: see errors.h
    int lit;                 // 1: light the agents' texels too
};

struct RenderParams {
    SceneryParams scenery;
    const float* positions;    // (N, A, 2)
    const float* angles;       // (N, A)
    const float* yaws;         // (C) degrees, added to the agent's angle
    const float* ray_lengths;  // (R) length of each ray per unit of depth
    int* error_flag;           // (1) out: see errors.h
    int n_cameras;             // C
    int res;                   // R
    float half_width;          // tan(fov / 2): the edge of the screen at unit depth
    float edge;                // ray r looks along (1, edge - pitch r)
    float pitch;
    float centre;  // a point (x, y) lies at ray centre - scale y / x
    float scale;
    float near;        // depth nearer than which nothing on the screen lies beyond the radius
    int* indices;      // (N, A, C, R) out: line hit, the agents' first; -1 a miss
    float* locations;  // (N, A, C, R) out: fraction along the line
    float* dots;       // (N, A, C, R) out: cosine between ray and line
    float* distances;  // (N, A, C, R) out: metres
    float* screen;     // (N, A, C, R, 3) out
    int subsample;     // rays per pixel
    int n_pixels;      // P = R / subsample
    float inv_subsample;
    float inv_max_depth;              // per metre
    unsigned short* rgb;              // (N, A, C, 3, P) out: fp16
    unsigned short* depth;            // (N, A, C, P) out: fp16, 1 at the radius, falling to 0
    int* centre_line;                 // (N, A, C) out: line at the centre of the screen
    int* agent_ray;                   // (N, A, C) out: nearest to it that shows an agent, or -1
    const float* velocity;            // (N, A, 2) for imu
    const float* angvelocity;         // (N, A) for imu
    unsigned short* imu;              // (N, A, 3) out: fp16
    unsigned int* seen;               // (N, A, n_words) in and out: a bit per static texel
    const unsigned char* clear_mask;  // (N, A) where not 0, seen is cleared first
    int* newly_seen;                  // (N, A) out: texels marked in seen now, not before
    int n_words;
};

struct CoverageParams {
    SceneryParams scenery;
    const unsigned int* seen;     // (N, A, n_words) a bit per static texel
    const unsigned int* visible;  // (D, n_words) a bit per static texel
    const unsigned char* mask;    // (N, A) agents that are asked for
    int* error_flag;              // (1) out: see errors.h
    float* coverage;              // (N, A) out: 0 where not asked for
    int n_words;
};

struct PongParams {
    int* games;                // (13, N) in and out: the fields of Game, in their order
    const long long* actions;  // (B) lane B = N sides: 0 nothing, 1 up, 2 down
    float* reward;             // (B) out, as all that follows
    unsigned char* reset;      // (B)
    unsigned char* terminal;   // (B)
    unsigned char* truncated;  // (B)
    float* points_won;         // (B) share of a game's points where it ends; 0 elsewhere
    unsigned short* features;  // (B, 8) fp16
    unsigned char* pixels;     // (B, 30, 40)
    int* error_flag;           // (1) out: see errors.h
    unsigned int key0;         // the seed
    unsigned int key1;
    int n_envs;         // N
    int n_sides;        // that act: 2, or 1, the left, against the tracker
    int restart;        // 1: every environment begins a game
    int points;         // that win a game
    int limit;          // steps of a game
    int tracker_speed;  // 256ths of a cell per step
    int n_threads;      // of the CPU
};

struct SeekParams {
    SceneryParams scenery;
    const float* positions;  // (N, A, 2)
    const float* angles;     // (N, A)
    const float* free;       // (N, A) fraction of the step that was free; null: none was taken
    const int* spawned;      // (N, A) the layout's spawn point, where an episode begins
    const float* points;     // (D, n_goals, 2) the goals
    const unsigned short* fields;  // fp16: of each layout (n_goals, height, width) cells, in metres
    const long long* starts;       // (D) first cell of each layout's fields
    const int* shapes;             // (D, 2) height, width
    const float* origins;          // (D, 2) the centre of the first cell
    const float* lengths;          // (D, n_spawns, n_goals) of the shortest ways
    const int* in_range;           // (D, n_spawns, n_goals) goals, those first that may be drawn
    const int* n_in_range;         // (D, n_spawns) how many those are
    int* draws;                    // (N, A) in and out, as the next four: goals drawn so far
    int* goals;                    // (N, A) each agent's, of the goals of its layout
    float* journey;                // (7, N, A) see seek.h
    int* ages;                     // (N, A) steps since the first observation
    unsigned char* ended;  // (N, A) in: begins an episode in this step; out: ends it in this step
    int* error_flag;       // (1) out: see errors.h
    float* reward;         // (N, A) out, as all that follows
    unsigned char* reset;  // (N, A)
    unsigned char* terminal;   // (N, A)
    unsigned char* truncated;  // (N, A)
    float* metrics;           // (4, N, A) where an episode ends: success, SPL, soft SPL, collisions
    unsigned short* bearing;  // (N, A, 3) fp16: tens of metres straight to it, cosine and sine
    float* told;              // (N, A, 4) what a critic is told; null: nothing
    unsigned int key0;        // the seed
    unsigned int key1;
    float per_cell;  // one over a cell's side
    float reach;     // metres from the goal: there
    float bonus;     // for being there
    float cost;      // of a step
    int limit;       // steps of an episode
    int n_goals;     // per layout
    int n_spawns;    // per layout
};

struct ShootParams {
    const int* centre_line;  // (N, A) line at the centre of each view, of their environment's
    const int* agent_ray;    // (N, A) ray nearest to it that shows an agent, or -1; null: no aim
    const float* positions;  // (N, A, 2) for told
    const float* angles;     // (N, A) for told
    float* health;           // (N, A) in and out, as the next three: 1 is whole
    float* tally;            // (3, N, A) of an episode so far: kills, damage, hits
    int* ages;               // (N, A) steps since the first observation
    unsigned char* ended;    // (N, A) in: begins an episode in this step; out: ends it in this step
    float* reward;           // (N, A) out, as all that follows
    unsigned char* reset;    // (N, A)
    unsigned char* terminal;   // (N, A)
    unsigned char* truncated;  // (N, A)
    float* metrics;            // (4, N, A) where an episode ends: kills, deaths, damage, accuracy
    unsigned short* vitals;    // (N, A, 3) fp16: health, whether it hit, how many hit it
    float* told;               // (N, A, 1 + 5 (A - 1)): what a critic is told
    float damage;              // health that a hit takes
    float recovery;            // health that a step without a wound gives back
    float drain;               // health that a step takes
    float spoils;              // health that a hit gives to whom it is due
    float hit_reward;
    float wound_cost;
    float kill_reward;
    float death_cost;
    float aim_reward;  // for an agent in the middle of the view, falling to 0 at its edge
    int limit;         // steps of an episode
    int res;           // rays per view
    int n_envs;        // N
    int n_agents;      // A
    int n_model;       // M
    int n_threads;     // of the CPU
};

struct SpawnParams {
    SceneryParams scenery;
    float* positions;           // (N, A, 2) out, as the next three, where mask
    float* angles;              // (N, A)
    float* velocity;            // (N, A, 2)
    float* angvelocity;         // (N, A)
    const unsigned char* mask;  // (N, A) agents that respawn
    const float* points;        // (D, n_points, 2) where agents may stand
    int* counts;                // (N, A) numbers that each agent has drawn
    int* chosen;                // (N, A) out: the layout's point, where mask
    int* error_flag;            // (1) out: see errors.h
    unsigned int key0;          // the seed
    unsigned int key1;
    int n_points;
    int resample;  // 1: an environment all of whose agents respawn moves to another layout
};

struct UnseenParams {
    SceneryParams scenery;
    const float* positions;       // (N, A, 2)
    const float* angles;          // (N, A)
    const unsigned int* seen;     // (N, A, n_words) a bit per static texel
    const unsigned int* visible;  // (D, n_words) a bit per static texel
    int* error_flag;              // (1) out: see errors.h
    int* counts;                  // (N, A, bands, sectors) out
    int n_words;
};

struct UniformParams {
    const int* counts;          // (B) numbers that each lane has drawn
    const unsigned char* mask;  // (B) lanes that draw; others keep what out holds
    float* out;                 // (B, 4) uniform in [0, 1)
    unsigned int key0;          // the seed
    unsigned int key1;
    int n_lanes;    // B
    int n_threads;  // of the CPU
};
