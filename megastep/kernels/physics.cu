// A team of lanes a world, 8 where there are many worlds, 32 where there are few: for each agent in turn they go over boxes around 32 walls each, then over the walls
// of those that its path meets, and over the other agents; then the agents move together.
KERNEL BOUNDS physics(Motion p) {
    const World& w = p.world;
    int T = p.team, world = (blockIdx.x * blockDim.x + threadIdx.x) / T, lane = threadIdx.x & (T - 1), A = w.n_agents;
    if (world >= w.n_worlds) return;
    int before = threadIdx.x % 32 - lane;
    unsigned int team = (T == 32 ? ~0u : (1u << T) - 1u) << before;
    if (p.actions) {
        for (int a = lane; a < A; a += T) steer(p, world, a);
        __syncwarp(team);
    }
    int design = w.design[world], first_wall = w.wall_starts[design], last_wall = w.wall_starts[design + 1];
    int first_box = w.box_starts[design], last_box = w.box_starts[design + 1];
    float rho = w.radius * INFLATION;
    for (int a = 0; a < A; a++) {
        int i = world * A + a;
        float px = p.positions[2 * i], py = p.positions[2 * i + 1];
        float dx = stride(px, p.velocity[2 * i], p.seconds), dy = stride(py, p.velocity[2 * i + 1], p.seconds);
        float contact = NO_CONTACT;
        for (int start = first_box; start < last_box; start += T) {
            int meets = 0;
            if (start + lane < last_box && (dx != 0.f || dy != 0.f)) {
                float4 b = ((const float4*)w.boxes)[start + lane];
                meets = boxes_meet(px, py, dx, dy, b.x, b.y, b.z, b.w, rho);
            }
            for (unsigned int some = __ballot_sync(team, meets) >> before; some; some &= some - 1) {
                int first = first_wall + 32 * (start - first_box + __ffs(some) - 1), last = first + 32 < last_wall ? first + 32 : last_wall;
                for (int j = first + lane; j < last; j += T) {
                    float4 b = ((const float4*)w.walls)[j];
                    contact = low(contact, sweep_segment(px, py, dx, dy, b.x, b.y, b.z, b.w, rho));
                }
            }
        }
        for (int other = lane; other < A; other += T) {
            int k = world * A + other;
            if (other != a)
                contact = low(contact, sweep_point(px - p.positions[2 * k], py - p.positions[2 * k + 1],
                    dx - stride(p.positions[2 * k], p.velocity[2 * k], p.seconds),
                    dy - stride(p.positions[2 * k + 1], p.velocity[2 * k + 1], p.seconds), 2.f * rho));
        }
        for (int step = T / 2; step; step /= 2) contact = low(contact, __shfl_xor_sync(team, contact, step));
        if (lane == 0) p.progress[i] = progress_of(contact);
    }
    __syncwarp(team);
    for (int a = lane; a < A; a += T) advance(p, world, a);
}
