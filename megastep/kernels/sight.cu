// One warp an agent, its cameras one after the other. Lanes take a wall each and find the pixels it covers; then the warp walks each visible wall's pixels
// together, keeping the largest inverse depth and its line. A warp owns its screen, so no atomics; walls come in order, so the first of equals stays.

DEVICE void raster_lines(const Camera& camera, const Screen& screen, const float* lines, int n, int offset, int skip_first, int skip_last,
                         float* inverse, int* index, int lane) {
    for (int start = 0; start < n; start += 32) {
        int l = start + lane;
        Span span = {0, 0, 0.f, 0.f, 0};
        if (l < n && (l < skip_first || l >= skip_last)) {
            float4 b = ((const float4*)lines)[l];
            span = span_of(camera, screen, b.x, b.y, b.z, b.w);
        }
        for (unsigned int some = __ballot_sync(~0u, span.first < span.last); some; some &= some - 1) {
            int k = __ffs(some) - 1;
            Span one = {__shfl_sync(~0u, span.first, k), __shfl_sync(~0u, span.last, k), __shfl_sync(~0u, span.base, k),
                        __shfl_sync(~0u, span.gain, k), __shfl_sync(~0u, span.close, k)};
            for (int r = one.first + lane; r < one.last; r += 32) {
                float here = inverse_depth(one, screen, r);
                if (here > inverse[r]) { inverse[r] = here; index[r] = offset + start + k; }
            }
            __syncwarp();
        }
    }
}

KERNEL sight(Sight p) {
    extern __shared__ float shared[];
    const World& w = p.world;
    int warp = threadIdx.x / 32, lane = threadIdx.x % 32, agent = blockIdx.x * (blockDim.x / 32) + warp;
    if (agent >= w.n_worlds * w.n_agents) return;
    int world = agent / w.n_agents, a = agent % w.n_agents, R = p.res;
    float* inverse = shared + 2 * R * warp;
    int* index = (int*)(inverse + R);
    Screen screen = screen_of(p);
    Scene scene = scene_of(w, world);
    if (lane == 0) notice(p.fault, world, p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    if (p.imu && lane == 1) feel(p, agent);
    if (p.seen && p.forget && p.forget[agent])
        for (int i = lane; i < p.n_words; i += 32) p.seen[agent * (long long)p.n_words + i] = 0u;
    int fresh = 0;
    for (int c = 0; c < p.n_cameras; c++) {
        Camera camera = camera_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent] + p.yaws[c]);
        for (int r = lane; r < R; r += 32) { inverse[r] = 0.f; index[r] = -1; }
        __syncwarp();
        if (w.n_agents > 1)
            raster_lines(camera, screen, scene.agent_lines, scene.n_agent_lines, 0, a * w.n_model, (a + 1) * w.n_model, inverse, index, lane);
        raster_lines(camera, screen, scene.walls, scene.n_walls, scene.n_agent_lines, 0, 0, inverse, index, lane);
        long long view = (long long)agent * p.n_cameras + c;
        if (p.middle && lane == 0) p.middle[view] = index[R / 2];
        for (int pixel = lane; pixel < R / p.subsample; pixel += 32)
            fresh += shade_pixel(p, screen, scene, camera, agent, view, pixel, inverse, index);
        __syncwarp();
    }
    if (p.fresh) {
        for (int step = 16; step; step /= 2) fresh += __shfl_xor_sync(~0u, fresh, step);
        if (lane == 0) p.fresh[agent] = fresh;
    }
}
