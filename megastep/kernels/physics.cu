// One warp a world: for each agent in turn lanes over boxes around 32 walls each, then over the walls of those that its path meets, and over the other agents; then
// the agents move together.
KERNEL physics(Motion p) {
    const World& w = p.world;
    int world = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32, A = w.n_agents;
    if (world >= w.n_worlds) return;
    if (p.actions) {
        for (int a = lane; a < A; a += 32) steer(p, world, a);
        __syncwarp();
    }
    int design = w.design[world];
    float rho = w.radius * INFLATION;
    for (int a = 0; a < A; a++) {
        int i = world * A + a;
        float px = p.positions[2 * i], py = p.positions[2 * i + 1];
        float dx = p.velocity[2 * i] * p.seconds, dy = p.velocity[2 * i + 1] * p.seconds;
        float contact = NO_CONTACT;
        for (int start = w.box_starts[design]; start < w.box_starts[design + 1]; start += 32) {
            int meets = 0;
            if (start + lane < w.box_starts[design + 1] && (dx != 0.f || dy != 0.f)) {
                float4 b = ((const float4*)w.boxes)[start + lane];
                meets = boxes_meet(px, py, dx, dy, b.x, b.y, b.z, b.w, rho);
            }
            for (unsigned int some = __ballot_sync(~0u, meets); some; some &= some - 1) {
                int j = w.wall_starts[design] + 32 * (start - w.box_starts[design] + __ffs(some) - 1) + lane;
                if (j >= w.wall_starts[design + 1]) continue;
                float4 b = ((const float4*)w.walls)[j];
                contact = low(contact, sweep_segment(px, py, dx, dy, b.x, b.y, b.z, b.w, rho));
            }
        }
        for (int other = lane; other < A; other += 32) {
            int k = world * A + other;
            if (other != a)
                contact = low(contact, sweep_point(px - p.positions[2 * k], py - p.positions[2 * k + 1],
                    dx - p.velocity[2 * k] * p.seconds, dy - p.velocity[2 * k + 1] * p.seconds, 2.f * rho));
        }
        for (int step = 16; step; step /= 2) contact = low(contact, __shfl_xor_sync(~0u, contact, step));
        if (lane == 0) p.progress[i] = progress_of(contact);
    }
    __syncwarp();
    for (int a = lane; a < A; a += 32) advance(p, world, a);
}
