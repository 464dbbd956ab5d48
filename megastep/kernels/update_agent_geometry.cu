// One warp per agent: moves its model to its pose and, if `lit`, lights its texels, one per warp
// lane. For each bounding box of 32 walls, the warp takes each light that some texel may still see.
// With one wall per warp lane, it rules out the walls that cannot occlude the light from any part
// of the agent. The remaining walls, often none, are tested against each texel until all texels are
// in shadow.
#include "common/scenery.h"
#include "corridor.h"
#include "update_agent_geometry.h"

// The lights [first, first + n), at most 32, and the corridor and the bounds of the path of one of
// them per warp lane.
struct Lights {
    int first, n;
    Corridor corridor;
    Float4 bounds;
};

DEVICE Lights lights_of(const SceneryParams& s, const Pose& pose, int first, int end,
                        int warp_lane) {
    // A warp lane without a light has the last one.
    int n = mini(end - first, WARP), light = 3 * (first + mini(warp_lane, n - 1));
    float x = s.lights[light], y = s.lights[light + 1];
    return {first, n, corridor_of(x, y, pose, s.reach), bounds_of(x, y, pose, s.reach)};
}

DEVICE float from_warp_lane(float x, int warp_lane) { return __shfl_sync(FULL_WARP, x, warp_lane); }

DEVICE Corridor from_warp_lane(const Corridor& corridor, int warp_lane) {
    return {from_warp_lane(corridor.dx, warp_lane), from_warp_lane(corridor.dy, warp_lane),
            from_warp_lane(corridor.width, warp_lane)};
}

// Removes `bit`, that of `light`, from `lit_by` if one of the walls from `first` on that are in the
// mask `candidates` occludes the light from this warp lane's texel at (x, y).
DEVICE void occlude(const SceneryParams& s, int first, unsigned int candidates, int light,
                    unsigned int bit, float x, float y, unsigned int& lit_by) {
    float light_x = s.lights[3 * light], light_y = s.lights[3 * light + 1];
    float dx = x - light_x, dy = y - light_y;
    for (; candidates; candidates &= candidates - 1) {
        Float4 wall = LOAD((const Float4*)s.walls + (first + __ffs(candidates) - 1));
        if (occludes(occluder_of(light_x, light_y, wall.x, wall.y, wall.z, wall.w), dx, dy))
            lit_by &= ~bit;
        if (!__any_sync(FULL_WARP, lit_by & bit))
            return;
    }
}

// Returns a mask of the lights that no wall occludes from this warp lane's texel at (x, y). Warp
// lanes without a texel pass `has_texel` = 0.
DEVICE unsigned int unoccluded(const SceneryParams& s, const Pose& pose, const Walls& walls,
                               const Lights& lights, int warp_lane, float x, float y,
                               int has_texel) {
    unsigned int lit_by = has_texel ? FULL_WARP >> (WARP - lights.n) : 0;
    for (int box = walls.first_box; box < walls.end_box; box++) {
        Float4 bounds = LOAD((const Float4*)s.boxes + box);
        unsigned int near = __ballot_sync(FULL_WARP, overlap(bounds, lights.bounds)) &
                            __reduce_or_sync(FULL_WARP, lit_by);
        int first = walls.first_wall + BOX_WALLS * (box - walls.first_box);
        FacingWall wall = no_wall();
        if (near && first + warp_lane < walls.end_wall)
            wall = facing_wall(LOAD((const Float4*)s.walls + (first + warp_lane)), pose, s.reach);
        for (; near; near &= near - 1) {
            int l = __ffs(near) - 1;
            int maybe = may_occlude(from_warp_lane(lights.corridor, l), wall);
            unsigned int candidates = __ballot_sync(FULL_WARP, maybe);
            if (candidates)
                occlude(s, first, candidates, lights.first + l, 1u << l, x, y, lit_by);
        }
    }
    return lit_by;
}

KERNEL BOUNDS(20) update_agent_geometry(UpdateAgentGeometryParams p) {
    wait_for_previous();
    const SceneryParams& s = p.scenery;
    int agent = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, warp_lane = threadIdx.x % WARP;
    if (agent >= s.n_envs * s.n_agents)
        return;
    int env = agent / s.n_agents, a = agent % s.n_agents;
    Pose pose = pose_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    for (int m = warp_lane; m < s.n_model; m += WARP)
        update_line(s, pose, agent, m);
    if (!p.lit)
        return;
    __syncwarp();
    int layout = layout_of(s, env, p.error_flag);
    Walls walls = walls_of(s, layout);
    int end_light = s.light_starts[layout + 1], end = s.model_texels[(a + 1) * s.n_model];
    for (int base = s.model_texels[a * s.n_model]; base < end; base += WARP) {
        int texel = base + warp_lane;
        float x = pose.x, y = pose.y, sum = AMBIENT;
        if (texel < end)
            agent_texel_centre(s, env, a, texel, x, y);
        for (int first = s.light_starts[layout]; first < end_light; first += WARP) {
            Lights lights = lights_of(s, pose, first, end_light, warp_lane);
            unsigned int lit_by = unoccluded(s, pose, walls, lights, warp_lane, x, y, texel < end);
            for (; lit_by; lit_by &= lit_by - 1) {
                const float* light = s.lights + 3 * (first + __ffs(lit_by) - 1);
                sum += irradiance(light[2], x - light[0], y - light[1]);
            }
        }
        if (texel < end)
            s.agent_light[env * (long long)s.n_agent_texels + texel] = minf(sum, 1.f);
    }
}
