// One warp per agent: moves its model to its pose and, if `lit`, lights its texels, one per warp
// lane. For each bounding box of 32 walls, the warp takes each light that some texel may still see.
// With one wall per warp lane, it rules out the walls that cannot occlude the light from any part
// of the agent. The remaining walls, often none, are tested against each texel until all texels are
// in shadow.
#include "update_agent_geometry.h"

// ---- Which walls could occlude a light ----
//
// Conservative: a wall is ruled out only if, by a margin for rounding, all of it lies to one side
// of the path from the light to the agent, or the light and the whole agent lie on the same side of
// it. All texels of an agent are within `reach` of its centre.

constexpr float MARGIN = 1e-3f;  // of distances in metres, and of areas in square metres

// A vector's length, overestimated by up to an eighth.
HD float length_at_most(float x, float y) {
    float wide = ABS(x), tall = ABS(y);
    return maxf(wide, tall) + 0.5f * minf(wide, tall);
}

// The path (dx, dy) from a light to an agent's centre. Walls matter up to half of `width` to either
// side of it, which is a distance times the path's length.
struct Corridor {
    float dx, dy, width;
};

HD Corridor corridor_of(float light_x, float light_y, const Pose& agent, float reach) {
    float dx = agent.x - light_x, dy = agent.y - light_y;
    return {dx, dy, 2.f * (reach * length_at_most(dx, dy) + MARGIN)};
}

// A box around a light and all of an agent's texels: min x, min y, max x, max y.
HD Float4 bounds_of(float light_x, float light_y, const Pose& agent, float reach) {
    float aside = reach + MARGIN;
    return {minf(light_x, agent.x) - aside, minf(light_y, agent.y) - aside,
            maxf(light_x, agent.x) + aside, maxf(light_y, agent.y) + aside};
}

HD int overlap(const Float4& box, const Float4& other) {
    return (box.x <= other.z) & (box.y <= other.w) & (box.z >= other.x) & (box.w >= other.y);
}

// A wall's ends a and b relative to an agent's centre, in the order in which a x b is not negative.
// It cannot occlude a light from the agent if side_b - side_a of may_occlude exceeds `limit`.
struct FacingWall {
    float ax, ay, bx, by, limit;
};

// The area w x v of a wall v that begins at w from a point tells on which side of the wall the
// point is. From an agent to a light, it changes by side_b - side_a. There is no limit if the
// wall's line may cut the agent.
HD FacingWall facing_wall(const Float4& wall, const Pose& agent, float reach) {
    float ax = wall.x - agent.x, ay = wall.y - agent.y;
    float bx = wall.z - agent.x, by = wall.w - agent.y;
    float vx = wall.z - wall.x, vy = wall.w - wall.y;
    float signed_area = cross(ax, ay, vx, vy);
    float area = ABS(signed_area);
    float limit = area > reach * length_at_most(vx, vy) + MARGIN ? MARGIN - area : INF_VALUE;
    if (signed_area < 0.f)
        return {bx, by, ax, ay, limit};
    return {ax, ay, bx, by, limit};
}

// Returns 0 only if the wall cannot occlude the light from any part of the agent.
HD int may_occlude(const Corridor& corridor, const FacingWall& wall) {
    float side_a = cross(corridor.dx, corridor.dy, wall.ax, wall.ay);
    float side_b = cross(corridor.dx, corridor.dy, wall.bx, wall.by);
    float turn = side_b - side_a;
    return (turn <= wall.limit) & (ABS(side_a + side_b) <= ABS(turn) + corridor.width);
}

// ---- Light on agents ----

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
        FacingWall wall = {0.f, 0.f, 0.f, 0.f, -INF_VALUE};  // none
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
