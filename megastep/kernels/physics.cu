// Physics by groups of 8, 16 or 32 threads, one per environment. For each agent in turn, the
// group tests the bounding boxes (of 32 walls each), then the walls in boxes that the agent's path
// overlaps, then the other agents. Finally all agents move at once.
//
// `physics` is for many environments: so many threads per multiprocessor that 40 registers are left
// for each, which spills some. `unspilled` has fewer, with 56 registers each: faster until there
// are many.
#include "physics.h"

// SIZE neighbouring threads of a warp; this one is number `rank`. The group starts at warp lane
// `first`, and `mask` has a bit for each of its warp lanes.
struct ThreadGroup {
    int SIZE, rank, first;
    unsigned int mask;
};

DEVICE ThreadGroup group_of(int size) {
    int rank = threadIdx.x & (size - 1);
    int first = threadIdx.x % WARP - rank;
    unsigned int mask = (size == WARP ? FULL_WARP : (1u << size) - 1u) << first;
    return {size, rank, first, mask};
}

// The earliest contact, among the walls that this thread tests, of an agent at p that moves by d.
DEVICE float sweep_walls(const SceneryParams& s, const ThreadGroup& group, const Walls& walls,
                         float px, float py, float dx, float dy, float rho) {
    float contact = NO_CONTACT;
    for (int start = walls.first_box; start < walls.end_box; start += group.SIZE) {
        int meets = 0;
        if (start + group.rank < walls.end_box && (dx != 0.f || dy != 0.f)) {
            float4 box = ((const float4*)s.boxes)[start + group.rank];
            meets = boxes_meet(px, py, dx, dy, box.x, box.y, box.z, box.w, rho);
        }
        unsigned int boxes = __ballot_sync(group.mask, meets) >> group.first;
        for (; boxes; boxes &= boxes - 1) {
            int first = walls.first_wall + BOX_WALLS * (start - walls.first_box + __ffs(boxes) - 1);
            int end = mini(first + BOX_WALLS, walls.end_wall);
            for (int j = first + group.rank; j < end; j += group.SIZE) {
                float4 wall = ((const float4*)s.walls)[j];
                contact = minf(contact,
                               sweep_segment(px, py, dx, dy, wall.x, wall.y, wall.z, wall.w, rho));
            }
        }
    }
    return contact;
}

DEVICE float least(const ThreadGroup& group, float contact) {
    for (int step = group.SIZE / 2; step; step /= 2)
        contact = minf(contact, __shfl_xor_sync(group.mask, contact, step));
    return contact;
}

template <int with_objects>
DEVICE void move_agents(const PhysicsParams& p) {
    int n_agents = p.scenery.n_agents;
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / p.threads_per_env;
    if (env >= p.scenery.n_envs)
        return;
    ThreadGroup group = group_of(p.threads_per_env);
    if (with_objects)
        for (int k = group.rank; k < p.objects.n_objects; k += group.SIZE)
            PREFETCH(objects_of(p.objects) + env * p.objects.n_objects + k);
    if (p.actions)
        for (int a = group.rank; a < n_agents; a += group.SIZE)
            apply_action(p, env, env * n_agents + a);
    if (p.controls)
        for (int a = group.rank; a < n_agents; a += group.SIZE)
            apply_controls(p, env, env * n_agents + a);
    __syncwarp(group.mask);
    Walls walls = walls_of(p.scenery, layout_of(p.scenery, env, p.error_flag));
    auto of_walls = [&](float px, float py, float dx, float dy, float rho) {
        return sweep_walls(p.scenery, group, walls, px, py, dx, dy, rho);
    };
    for (int a = 0; a < n_agents; a++)
        sweep<with_objects>(p, group, env, a, of_walls);
    __syncwarp(group.mask);
    for (int a = group.rank; a < n_agents; a += group.SIZE)
        advance(p, env, a);
}

INSTANCE(BOUNDS(24) physics, PhysicsParams, move_agents<0>)
INSTANCE(BOUNDS(24) physics_objects, PhysicsParams, move_agents<1>)
INSTANCE(BOUNDS(18) physics_unspilled, PhysicsParams, move_agents<0>)
INSTANCE(BOUNDS(18) physics_objects_unspilled, PhysicsParams, move_agents<1>)
