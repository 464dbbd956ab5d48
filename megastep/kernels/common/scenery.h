// Scenery as kernels see it, and where a layout's walls lie.
//
// N environments, D layouts, A agents per environment, M lines of the agent model, K texels of one
// environment's agents. W walls, T texels and l lights of all layouts together.
#pragma once
#include "common/errors.h"

struct SceneryParams {
    const float* walls;           // (W, 4) ax ay bx by in metres, layout after layout
    const int* wall_starts;       // (D + 1) first wall of each layout
    const int* texel_starts;      // (W + 1) first texel of each wall
    const float* boxes;           // (., 4) min x, min y, max x, max y of each BOX_WALLS walls
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
    int n_threads;       // CPU threads
    float radius;        // metres: closer walls are not rendered; inflated, the disc that collides
    float reach;         // metres: at least the model's extent from its origin
};

// `index` if it is in [0, n). Else it is flagged as an error of this kind, and read as 0.
HD int checked(int index, int n, int* error_flag, int env, int kind) {
    if ((unsigned int)index < (unsigned int)n)
        return index;
    flag_error(error_flag, env, kind);
    return 0;
}

HD int layout_of(const SceneryParams& s, int env, int* error_flag) {
    return checked(s.layout[env], s.n_layouts, error_flag, env, BAD_LAYOUT);
}

// CPU threads for n agents. Fewer than `min` take one thread less time than another takes to wake,
// 50 us.
HD int threads_for(const SceneryParams& s, int n, int min) { return n < min ? 1 : s.n_threads; }

HD int threads_for_agents(const SceneryParams& s, int min) {
    return threads_for(s, s.n_envs * s.n_agents, min);
}

// A layout's walls [first_wall, end_wall) and bounding boxes [first_box, end_box).
struct Walls {
    int first_wall, end_wall, first_box, end_box;
};

HD Walls walls_of(const SceneryParams& s, int layout) {
    return {s.wall_starts[layout], s.wall_starts[layout + 1], s.box_starts[layout],
            s.box_starts[layout + 1]};
}
