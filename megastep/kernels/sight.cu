// One warp an agent, its cameras one after the other. Lanes take a wall each and find the pixels it covers; the visible ones are put side by side in shared
// memory, and the warp walks them in order, keeping each pixel's largest inverse depth and its line. Pixel r belongs to lane r % 32: no atomics, no barriers
// between walls, and the first of equals stays. Then each lane shades its rays, and neighbours add theirs up into pixels.

struct __align__(16) Covered { int bounds; float base, gain; int line; };      // pixels [first, last) in 16 bits each; the sign bit of line says that it comes within the radius
struct __align__(8) Nearest { float inverse; int line; };

DEVICE void raster_lines(const Camera& camera, const Screen& screen, const float* lengths, const float* lines, int n, int offset, int skip_first, int skip_last,
                         Covered* covered, Nearest* nearest, int lane) {
    for (int start = 0; start < n; start += 32) {
        int l = start + lane;
        Span span = {0, 0, 0.f, 0.f, 0};
        if (l < n && (l < skip_first || l >= skip_last)) {
            float4 b = ((const float4*)lines)[l];
            span = span_of(camera, screen, b.x, b.y, b.z, b.w);
        }
        unsigned int some = __ballot_sync(~0u, span.first < span.last);
        __syncwarp();
        if (span.first < span.last) {
            Covered mine = {span.first | span.last << 16, span.base, span.gain, (offset + l) | (span.close ? 1 << 31 : 0)};
            covered[__popc(some & ((1u << lane) - 1u))] = mine;
        }
        __syncwarp();
        int n_covered = __popc(some);
        for (int i = 0; i < n_covered; i++) {
            Covered one = covered[i];
            int first = one.bounds & 0xffff, last = one.bounds >> 16;
            for (int r = (first & ~31) + lane; r < last; r += 32) {
                float inverse = one.base + one.gain * (float)r;
                if (one.line < 0 && inverse * screen.radius >= lengths[r]) continue;
                if (r >= first && inverse > nearest[r].inverse) { Nearest here = {inverse, one.line & 0x7fffffff}; nearest[r] = here; }
            }
        }
    }
}

KERNEL BOUNDS sight(Sight p) {
    extern __shared__ Nearest shared[];
    const World& w = p.world;
    int warp = threadIdx.x / 32, lane = threadIdx.x % 32, agent = blockIdx.x * (blockDim.x / 32) + warp;
    if (agent >= w.n_worlds * w.n_agents) return;
    int world = agent / w.n_agents, a = agent % w.n_agents, R = p.res, S = p.subsample;
    __shared__ Covered all_covered[32 * 4];
    Covered* covered = all_covered + 32 * warp;
    Nearest* nearest = shared + R * warp;
    Screen screen = screen_of(p);
    Scene scene = scene_of(w, world);
    if (lane == 0) notice(p.fault, world, p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    if (p.imu && lane == 1) feel(p, agent);
    if (p.seen && p.forget && p.forget[agent])
        for (int i = lane; i < p.n_words; i += 32) p.seen[agent * (long long)p.n_words + i] = 0u;
    int fresh = 0, batch = 32 / S * S;
    for (int c = 0; c < p.n_cameras; c++) {
        Camera camera = camera_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent] + p.yaws[c]);
        Nearest nothing = {0.f, -1};
        for (int r = lane; r < R; r += 32) nearest[r] = nothing;
        if (w.n_agents > 1)
            raster_lines(camera, screen, p.ray_lengths, scene.agent_lines, scene.n_agent_lines, 0, a * w.n_model, (a + 1) * w.n_model, covered, nearest, lane);
        raster_lines(camera, screen, p.ray_lengths, scene.walls, scene.n_walls, scene.n_agent_lines, 0, 0, covered, nearest, lane);
        __syncwarp();
        long long view = (long long)agent * p.n_cameras + c;
        if (p.middle && lane == 0) p.middle[view] = nearest[R / 2].line;
        for (int start = 0; start < R; start += batch) {
            int r = start + lane, on = lane < batch && r < R;
            Ray ray = {0.f, 0.f, 0.f, 0.f};
            if (on) ray = shade_ray(p, screen, scene, camera, agent, view, r, nearest[r].inverse, nearest[r].line, fresh);
            Ray sum = ray;
            for (int j = 1; j < S; j++) {
                sum.red += __shfl_down_sync(~0u, ray.red, j); sum.green += __shfl_down_sync(~0u, ray.green, j);
                sum.blue += __shfl_down_sync(~0u, ray.blue, j); sum.depth += __shfl_down_sync(~0u, ray.depth, j);
            }
            if (on && lane % S == 0) write_pixel(p, view, r / S, sum);
        }
        __syncwarp();
    }
    if (p.fresh) {
        for (int step = 16; step; step /= 2) fresh += __shfl_xor_sync(~0u, fresh, step);
        if (lane == 0) p.fresh[agent] = fresh;
    }
}
