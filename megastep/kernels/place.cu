// One warp an agent: carries its model to where it stands and, if asked, lights its texels, once each. For every light, boxes around 32 walls and then walls that cannot
// hide it from any part of the agent are passed over by all lanes together; the others are tried against each texel, until all texels are hidden.

DEVICE float from_lane(float x, int lane) { return __shfl_sync(~0u, x, lane); }

// Does a wall of the 32 from `first` on, one a lane, hide the light from the lane's texel, which lies d from it?
DEVICE int hidden_by_group(const World& w, const Corridor& corridor, int first, int end, int lane, float dx, float dy) {
    Blind mine = {0.f, 0.f, 0.f, 0.f, 0.f};
    int able = 0, hidden = 0;
    if (first + lane < end) {
        Four_floats b = LOAD((const Four_floats*)w.walls + (first + lane));
        mine = blind_of(corridor.x, corridor.y, b.x, b.y, b.z, b.w);
        able = (mine.area > 0.f) & may_block(corridor, b.x, b.y, b.z, b.w);
    }
    for (unsigned int some = __ballot_sync(~0u, able); some; some &= some - 1) {
        int k = __ffs(some) - 1;
        Blind blind = {from_lane(mine.vx, k), from_lane(mine.vy, k), from_lane(mine.wx, k), from_lane(mine.wy, k), from_lane(mine.area, k)};
        hidden |= blocks(blind, dx, dy);
    }
    return hidden;
}

KERNEL place(Placing p) {
    const World& w = p.world;
    int agent = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
    if (agent >= w.n_worlds * w.n_agents) return;
    int world = agent / w.n_agents, a = agent % w.n_agents, M = w.n_model, design = w.design[world];
    Pose pose = pose_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    for (int m = lane; m < M; m += 32) place_line(w, pose, agent, m);
    if (!p.lit) return;
    __syncwarp();
    int first_wall = w.wall_starts[design], end_wall = w.wall_starts[design + 1], first_box = w.box_starts[design], n_boxes = w.box_starts[design + 1] - first_box;
    int last = w.model_texels[(a + 1) * M];
    for (int base = w.model_texels[a * M]; base < last; base += 32) {
        int texel = base + lane;
        float x = pose.x, y = pose.y, sum = AMBIENT;
        if (texel < last) agent_texel(w, world, a, texel, x, y);
        for (int l = w.light_starts[design]; l < w.light_starts[design + 1]; l++) {
            const float* light = w.lights + 3 * l;
            float dx = x - light[0], dy = y - light[1];
            Corridor corridor = corridor_of(light[0], light[1], pose, w.reach);
            int hidden = texel >= last;
            for (int start = 0; start < n_boxes; start += 32) {
                int may = 0;
                if (start + lane < n_boxes) {
                    Four_floats b = LOAD((const Four_floats*)w.boxes + (first_box + start + lane));
                    may = may_block_box(corridor, b.x, b.y, b.z, b.w);
                }
                for (unsigned int boxes = __ballot_sync(~0u, may); boxes && !__all_sync(~0u, hidden); boxes &= boxes - 1)
                    hidden |= hidden_by_group(w, corridor, first_wall + 32 * (start + __ffs(boxes) - 1), end_wall, lane, dx, dy);
            }
            if (!hidden) sum += glow(light[2], dx, dy);
        }
        if (texel < last) w.agent_light[world * w.n_agent_texels + texel] = low(sum, 1.f);
    }
}
