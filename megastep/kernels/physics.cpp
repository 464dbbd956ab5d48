// A loop over environments. For each agent, a vectorised loop finds the walls whose bounding boxes
// the agent's path overlaps; only those are tested exactly.
#include <vector>

#include "physics.h"

constexpr int MIN_PARALLEL = 1024;  // agents

static float sweep_walls(const float* walls, int n, unsigned char* meets, float px, float py,
                         float dx, float dy, float rho) {
    if (dx == 0.f && dy == 0.f)
        return NO_CONTACT;
#pragma omp simd
    for (int j = 0; j < n; j++)
        meets[j] = (unsigned char)boxes_meet(px, py, dx, dy, walls[4 * j], walls[4 * j + 1],
                                             walls[4 * j + 2], walls[4 * j + 3], rho);
    float contact = NO_CONTACT;
    for (int j = 0; j < n; j++) {
        if (!meets[j])
            continue;
        const float* wall = walls + 4 * j;
        contact =
            minf(contact, sweep_segment(px, py, dx, dy, wall[0], wall[1], wall[2], wall[3], rho));
    }
    return contact;
}

static float least(const SingleThread&, float contact) { return contact; }

static void step(const PhysicsParams& p, int env, std::vector<unsigned char>& meets) {
    const SceneryParams& s = p.scenery;
    int n_agents = s.n_agents, layout = layout_of(s, env, p.error_flag);
    int first_wall = s.wall_starts[layout], n_walls = s.wall_starts[layout + 1] - first_wall;
    const float* walls = s.walls + 4 * (long long)first_wall;
    if ((int)meets.size() < n_walls)
        meets.resize(n_walls);
    if (p.actions)
        for (int a = 0; a < n_agents; a++)
            apply_action(p, env, env * n_agents + a);
    if (p.controls)
        for (int a = 0; a < n_agents; a++)
            apply_controls(p, env, env * n_agents + a);
    for (int a = 0; a < n_agents; a++)
        sweep<1>(p, SingleThread{0}, env, a,
                 [&](float px, float py, float dx, float dy, float rho) {
                     return sweep_walls(walls, n_walls, meets.data(), px, py, dx, dy, rho);
                 });
    for (int a = 0; a < n_agents; a++)
        advance(p, env, a);
}

KERNEL physics(const PhysicsParams& p) {
    const SceneryParams& s = p.scenery;
    int n_threads = threads_for_agents(s, MIN_PARALLEL);
#pragma omp parallel num_threads(n_threads)
    {
        std::vector<unsigned char> meets;
#pragma omp for schedule(static)
        for (int env = 0; env < s.n_envs; env++)
            step(p, env, meets);
    }
}

KERNEL physics_objects(const PhysicsParams& p) { physics(p); }
