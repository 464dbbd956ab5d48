// What every launch is given, by value. compile.py reads these structs and builds their ctypes twins, so the layout has one home.
// N worlds, D designs, A agents a world, M lines of the agent model, K texels of one world's agents, C cameras an agent, R rays a camera.
// A pointer on a line of its own, one field a line. A null pointer means: this output is not wanted.

struct World {
    const float* walls;            // (W, 4) ax ay bx by, metres: the static walls of all designs, one design after the other
    const int* wall_starts;        // (D + 1) first wall of each design
    const int* texel_starts;       // (W + 1) first texel of each wall
    const float* boxes;            // (sum of ceil(walls / 32) over designs, 4) low x, low y, high x, high y of each 32 walls of a design
    const int* box_starts;         // (D + 1) first box of each design
    float* texels;                 // (T, 4) red green blue light of each static texel
    const float* lights;           // (l, 3) x y intensity
    const int* light_starts;       // (D + 1)
    int* design;                   // (N) which design a world shows
    const float* model;            // (M, 4) the agent model about its own origin
    const int* model_texels;       // (A M + 1) first texel of each agent line within its world's K
    const float* agent_textures;   // (D, K, 3)
    float* agent_lines;            // (N, A M, 4) the agents' lines as last placed
    float* agent_light;            // (N, K) light on the agents' texels as last placed
    int n_worlds;
    int n_agents;
    int n_model;
    int n_agent_texels;            // K
    int n_threads;                 // CPU only
    float radius;                  // metres: near limit of sight, and of collision once inflated
    float reach;                   // metres: how far the model extends from its origin
};

struct Bake {
    World world;
    const int* texel_wall;         // (T) the wall each texel lies on
    const int* wall_design;        // (W) the design each wall belongs to
    int n_texels;
};

struct Motion {
    World world;
    float* positions;              // (N, A, 2) metres, moved in place
    float* angles;                 // (N, A) degrees, turned in place
    float* velocity;               // (N, A, 2) metres a second
    float* angvelocity;            // (N, A) degrees a second
    float* progress;               // (N, A) out: fraction of the step that was free, in [0, 1]
    int* fault;                    // (1) out: 1 + the world of an agent whose position, angle or velocity is not finite; minus that for an action that is none
    const long long* actions;      // (N, A) null: velocities stay as they are
    const float* moves;            // (n_moves, 3) velocity ahead and left, angular velocity: what each action adds
    int n_moves;
    float keep;                    // fraction of the old velocities that stays when an action is taken
    float seconds;                 // length of the step
    int team;                      // GPU only: lanes a world, a power of two up to 32
};

struct Placing {
    World world;
    const float* positions;        // (N, A, 2)
    const float* angles;           // (N, A)
    int lit;                       // 1: light the agents' texels too
};

struct Sight {
    World world;
    const float* positions;        // (N, A, 2)
    const float* angles;           // (N, A)
    const float* yaws;             // (C) degrees, added to the agent's angle
    const float* ray_lengths;      // (R) length of each ray per unit of depth
    int* fault;                    // (1) as in Motion
    int n_cameras;                 // C
    int res;                       // R
    float half_width;              // tan(fov / 2): the edge of the screen at unit depth
    float edge;                    // ray r looks along (1, edge - pitch r)
    float pitch;
    float centre;                  // a point (x, y) lies at ray centre - scale y / x
    float scale;
    float near;                    // depth nearer than which nothing on the screen lies beyond the radius
    int* indices;                  // (N, A, C, R) out: line hit within its world, agents' first; -1 a miss
    float* locations;              // (N, A, C, R) out: fraction along the line
    float* dots;                   // (N, A, C, R) out: cosine between ray and line
    float* distances;              // (N, A, C, R) out: metres
    float* screen;                 // (N, A, C, R, 3) out
    int subsample;                 // rays a pixel
    int n_pixels;                  // R / subsample
    float share;                   // 1 / subsample
    float per_depth;               // 1 / metres
    unsigned short* rgb;           // (N, A, C, 3, n_pixels) out: fp16
    unsigned short* depth;         // (N, A, C, n_pixels) out: fp16, 1 at the radius, 0 at 1 / per_depth beyond it
    int* middle;                   // (N, A, C) out: line at the middle of the screen
    const float* velocity;         // (N, A, 2) for imu
    const float* angvelocity;      // (N, A) for imu
    unsigned short* imu;           // (N, A, 3) out: fp16, angular velocity / 360, own velocity ahead and left / 10
    unsigned int* seen;            // (N, A, n_words) in and out: a bit for each static texel of the design
    const unsigned char* forget;   // (N, A) where not 0, seen is cleared first
    int* fresh;                    // (N, A) out: texels seen now that were not in seen
    int n_words;
};

struct Spawn {
    World world;
    float* positions;              // (N, A, 2) out, as all the rest, where mask
    float* angles;                 // (N, A)
    float* velocity;               // (N, A, 2)
    float* angvelocity;            // (N, A)
    const unsigned char* mask;     // (N, A) agents that respawn
    const float* points;           // (D, n_points, 2) where agents of each design may stand
    int* counts;                   // (N, A) how many draws each lane has made
    unsigned int seed_low;
    unsigned int seed_high;
    int n_points;
    int n_designs;                 // a world all of whose agents respawn moves to one of so many designs; 0: it stays
};

struct Draw {
    const int* counts;             // (B) how many draws each lane has made
    const unsigned char* mask;     // (B) lanes that draw; others keep what out holds
    float* out;                    // (B, 4) uniform in [0, 1)
    unsigned int seed_low;
    unsigned int seed_high;
    int n_lanes;
    int n_threads;
};
