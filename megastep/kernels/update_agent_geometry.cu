// One warp per agent: moves its model to its pose and, if `lit`, lights its texels, one per warp
// lane. For each light, the warp rules out the bounding boxes of 32 walls each, and then the walls,
// that cannot occlude the light from any part of the agent. The remaining walls are tested against
// each texel until all texels are in shadow.
#include "common/scenery.h"
#include "corridor.h"
#include "update_agent_geometry.h"

DEVICE float from_warp_lane(float x, int warp_lane) { return __shfl_sync(FULL_WARP, x, warp_lane); }

DEVICE Occluder from_warp_lane(const Occluder& wall, int warp_lane) {
    return {from_warp_lane(wall.vx, warp_lane), from_warp_lane(wall.vy, warp_lane),
            from_warp_lane(wall.wx, warp_lane), from_warp_lane(wall.wy, warp_lane),
            from_warp_lane(wall.area, warp_lane)};
}

// Returns 1 if one of the 32 walls from `first` on occludes the light from this warp lane's texel,
// which is at (dx, dy) from the light.
DEVICE int occluded_by_box(const SceneryParams& s, const Corridor& corridor, int first, int end,
                           int warp_lane, float dx, float dy) {
    Occluder occluder = {0.f, 0.f, 0.f, 0.f, 0.f};
    int maybe = 0, occluded = 0;
    if (first + warp_lane < end) {
        Float4 wall = LOAD((const Float4*)s.walls + (first + warp_lane));
        occluder = occluder_of(corridor.x, corridor.y, wall.x, wall.y, wall.z, wall.w);
        maybe = (occluder.area > 0.f) & may_occlude(corridor, wall.x, wall.y, wall.z, wall.w);
    }
    for (unsigned int walls = __ballot_sync(FULL_WARP, maybe); walls; walls &= walls - 1)
        occluded |= occludes(from_warp_lane(occluder, __ffs(walls) - 1), dx, dy);
    return occluded;
}

// Returns 1 if any wall occludes the light from this warp lane's texel, at (dx, dy) from the light.
// Warp lanes without a texel pass `occluded` = 1.
DEVICE int occluded_by_walls(const SceneryParams& s, const Corridor& corridor, const Walls& walls,
                             int warp_lane, float dx, float dy, int occluded) {
    int n_boxes = walls.end_box - walls.first_box;
    for (int start = 0; start < n_boxes; start += WARP) {
        int maybe = 0;
        if (start + warp_lane < n_boxes) {
            Float4 box = LOAD((const Float4*)s.boxes + (walls.first_box + start + warp_lane));
            maybe = box_may_occlude(corridor, box.x, box.y, box.z, box.w);
        }
        unsigned int boxes = __ballot_sync(FULL_WARP, maybe);
        for (; boxes && !__all_sync(FULL_WARP, occluded); boxes &= boxes - 1) {
            int first = walls.first_wall + BOX_WALLS * (start + __ffs(boxes) - 1);
            occluded |= occluded_by_box(s, corridor, first, walls.end_wall, warp_lane, dx, dy);
        }
    }
    return occluded;
}

KERNEL BOUNDS(20) update_agent_geometry(UpdateAgentGeometryParams p) {
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
    int end = s.model_texels[(a + 1) * s.n_model];
    for (int base = s.model_texels[a * s.n_model]; base < end; base += WARP) {
        int texel = base + warp_lane;
        float x = pose.x, y = pose.y, sum = AMBIENT;
        if (texel < end)
            agent_texel_centre(s, env, a, texel, x, y);
        for (int l = s.light_starts[layout]; l < s.light_starts[layout + 1]; l++) {
            const float* light = s.lights + 3 * l;
            float dx = x - light[0], dy = y - light[1];
            Corridor corridor = corridor_of(light[0], light[1], pose, s.reach);
            if (!occluded_by_walls(s, corridor, walls, warp_lane, dx, dy, texel >= end))
                sum += irradiance(light[2], dx, dy);
        }
        if (texel < end)
            s.agent_light[env * (long long)s.n_agent_texels + texel] = minf(sum, 1.f);
    }
}
