// One warp an agent: carries its model to where it stands and, if asked, lights its texels, once each. For every light, boxes around 32 walls and then walls that cannot
// hide it from any part of the agent are passed over by all lanes together; the others are tried against each texel, until all texels are hidden.
KERNEL place(Placing p) {
    const World& w = p.world;
    int agent = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
    if (agent >= w.n_worlds * w.n_agents) return;
    int world = agent / w.n_agents, a = agent % w.n_agents, M = w.n_model, design = w.design[world];
    Pose pose = pose_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    for (int m = lane; m < M; m += 32) place_line(w, pose, agent, m);
    if (!p.lit) return;
    __syncwarp();
    int first = w.model_texels[a * M], last = w.model_texels[(a + 1) * M];
    for (int base = first; base < last; base += 32) {
        int texel = base + lane;
        float x = pose.x, y = pose.y, sum = AMBIENT;
        if (texel < last) agent_texel(w, world, a, texel, x, y);
        for (int l = w.light_starts[design]; l < w.light_starts[design + 1]; l++) {
            const float* light = w.lights + 3 * l;
            float dx = x - light[0], dy = y - light[1];
            Corridor corridor = corridor_of(light[0], light[1], pose, w.reach);
            int hidden = texel >= last;
            for (int start = w.box_starts[design]; start < w.box_starts[design + 1]; start += 32) {
                int may = 0;
                if (start + lane < w.box_starts[design + 1]) {
                    float4 b = ((const float4*)w.boxes)[start + lane];
                    may = may_block_box(corridor, b.x, b.y, b.z, b.w);
                }
                for (unsigned int boxes = __ballot_sync(~0u, may); boxes && !__all_sync(~0u, hidden); boxes &= boxes - 1) {
                    int j = w.wall_starts[design] + 32 * (start - w.box_starts[design] + __ffs(boxes) - 1) + lane;
                    float4 b = {0.f, 0.f, 0.f, 0.f};
                    int able = 0;
                    if (j < w.wall_starts[design + 1]) {
                        b = ((const float4*)w.walls)[j];
                        able = may_block(corridor, b.x, b.y, b.z, b.w);
                    }
                    for (unsigned int some = __ballot_sync(~0u, able); some; some &= some - 1) {
                        int k = __ffs(some) - 1;
                        hidden |= blocks(light[0], light[1], dx, dy, __shfl_sync(~0u, b.x, k), __shfl_sync(~0u, b.y, k),
                            __shfl_sync(~0u, b.z, k), __shfl_sync(~0u, b.w, k));
                    }
                }
            }
            if (!hidden) sum += glow(light[2], dx, dy);
        }
        if (texel < last) w.agent_light[world * w.n_agent_texels + texel] = low(sum, 1.f);
    }
}
