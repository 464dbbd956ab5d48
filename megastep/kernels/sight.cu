// One warp an agent, its cameras one after the other. Walls stand in groups of 32 with a box around each: groups that cannot be seen are left out, the others come
// nearest first. Lanes take a wall each and find the pixels it covers; those not wholly behind what is already there stand side by side in shared memory, and
// the warp walks them, keeping each pixel's largest inverse depth and, of equals, the first line. Pixel r belongs to lane r % 32: no atomics and no barriers
// between walls. Then each lane shades its rays, and neighbours add theirs up into pixels.

struct __align__(16) Covered { int bounds; float base, gain; int line; };      // pixels [first, last) in 16 bits each; the sign bit of line: it comes within the radius
struct __align__(8) Nearest { float inverse; int line; };

// A warp's view in the making. Lane k knows `floor`, the smallest inverse depth among pixels 32 k to 32 k + 31.
struct View { const Camera& camera; const Screen& screen; const float* lengths; Covered* covered; Nearest* nearest; int lane; float floor; };

// 32 lines at once, one a lane; `on` where there is one. `line` is its number in the world.
DEVICE void raster_group(View& v, const float* ends, int line, int on) {
    int R = v.screen.res;
    Span span = {0, 0, 0.f, 0.f, 0};
    if (on) {
        float4 b = *(const float4*)ends;
        span = span_of(v.camera, v.screen, b.x, b.y, b.z, b.w);
    }
    int visible = span.first < span.last, from = visible ? span.first >> 5 : 0, to = visible ? (span.last - 1) >> 5 : 0;
    float most = high(span.base + span.gain * (float)span.first, span.base + span.gain * (float)(span.last - 1)), least = INFINITE;
    int widest = __reduce_max_sync(~0u, to - from);
    #pragma unroll 1
    for (int k = 0; k <= widest; k++) least = low(least, __shfl_sync(~0u, v.floor, from + k < to ? from + k : to));
    unsigned int some = __ballot_sync(~0u, visible && most >= least);
    if (!some) return;
    __syncwarp();
    if (some >> v.lane & 1u) {
        Covered mine = {span.first | span.last << 16, span.base, span.gain, line | (span.close ? 1 << 31 : 0)};
        v.covered[__popc(some & ((1u << v.lane) - 1u))] = mine;
    }
    __syncwarp();
    int n_covered = __popc(some);
    for (int i = 0; i < n_covered; i++) {
        Covered one = v.covered[i];
        int first = one.bounds & 0xffff, last = one.bounds >> 16, close = one.line < 0, r = (first & ~31) + v.lane;
        one.line &= 0x7fffffff;
        float at = (float)r;
        #pragma unroll 1
        for (; r < last; r += 32, at += 32.f) {                 // most spans take one or two rounds
            float inverse = one.base + one.gain * at;
            if (close && inverse * v.screen.radius >= v.lengths[r]) continue;
            Nearest here = v.nearest[r], mine = {inverse, one.line};
            if (r >= first && (inverse > here.inverse || (inverse == here.inverse && one.line < here.line))) v.nearest[r] = mine;
        }
    }
    int mine = some >> v.lane & 1, last_block = __reduce_max_sync(~0u, mine ? to : 0);
    #pragma unroll 1
    for (int k = __reduce_min_sync(~0u, mine ? from : 32); k <= last_block; k++) {
        int r = 32 * k + v.lane;
        unsigned int lowest = __reduce_min_sync(~0u, r < R ? __float_as_uint(v.nearest[r].inverse) : 0x7f800000u);
        if (v.lane == k) v.floor = __uint_as_float(lowest);
    }
}

DEVICE void raster_walls(View& v, const World& w, const Scene& scene, int design, float half_width) {
    int end = w.box_starts[design + 1];
    for (int start = w.box_starts[design]; start < end; start += 32) {
        unsigned int key = ~0u;
        Cover cover = {-1.f, 0.f, 0, 0};
        if (start + v.lane < end) {
            float4 b = ((const float4*)w.boxes)[start + v.lane];
            cover = cover_of(v.camera, v.screen, half_width, b.x, b.y, b.z, b.w);
            if (cover.distance >= 0.f) key = __float_as_uint(cover.distance);
        }
        int blocks = cover.first / 32 | cover.last / 32 << 16;
        for (unsigned int nearest = __reduce_min_sync(~0u, key); nearest != ~0u; nearest = __reduce_min_sync(~0u, key)) {
            int k = __ffs(__ballot_sync(~0u, key == nearest)) - 1;
            if (v.lane == k) key = ~0u;
            int both = __shfl_sync(~0u, blocks, k);
            float most = __shfl_sync(~0u, cover.most, k), floor = v.lane >= (both & 0xffff) && v.lane <= both >> 16 ? v.floor : INFINITE;
            if (__all_sync(~0u, floor > most)) continue;         // all of it is behind what is already there
            int l = 32 * (start - w.box_starts[design] + k) + v.lane;
            raster_group(v, scene.walls + 4 * l, scene.n_agent_lines + l, l < scene.n_walls);
        }
    }
}

// A lane's ray and those of the next lanes, `n` in all, in order.
DEVICE Ray sum_of(const Ray& ray, int n) {
    Ray sum = ray;
    for (int j = 1; j < n; j++) {
        sum.red += __shfl_down_sync(~0u, ray.red, j); sum.green += __shfl_down_sync(~0u, ray.green, j);
        sum.blue += __shfl_down_sync(~0u, ray.blue, j); sum.depth += __shfl_down_sync(~0u, ray.depth, j);
    }
    return sum;
}

KERNEL BOUNDS sight(Sight p) {
    extern __shared__ Nearest shared[];
    __shared__ Covered all_covered[64];
    const World& w = p.world;
    int warp = threadIdx.x / 32, lane = threadIdx.x % 32, agent = blockIdx.x * (blockDim.x / 32) + warp;
    if (agent >= w.n_worlds * w.n_agents) return;
    int world = w.n_agents == 1 ? agent : agent / w.n_agents, a = agent - world * w.n_agents, R = p.res, S = p.subsample;
    Nearest* nearest = shared + (R + R % 2) * warp;
    Screen screen = screen_of(p);
    Scene scene = scene_of(w, world);
    if (lane == 0) notice(p.fault, world, p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
    if (p.imu && lane < 3) feel(p, agent, lane);
    if (p.seen && p.forget && p.forget[agent])
        for (int i = lane; i < p.n_words; i += 32) p.seen[agent * (long long)p.n_words + i] = 0u;
    int fresh = 0, batch = 32 / S * S, leads = lane < batch && lane % S == 0;
    for (int c = 0; c < p.n_cameras; c++) {
        Camera camera = camera_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent] + p.yaws[c]);
        View v = {camera, screen, p.ray_lengths, all_covered + 32 * warp, nearest, lane, 0.f};
        Nearest nothing = {0.f, -1};
        for (int r = lane; r < R; r += 32) nearest[r] = nothing;
        if (w.n_agents > 1)
            for (int l = lane; l < (scene.n_agent_lines + 31) / 32 * 32; l += 32)
                raster_group(v, scene.agent_lines + 4 * l, l, l < scene.n_agent_lines && l / w.n_model != a);
        raster_walls(v, w, scene, w.design[world], p.half_width);
        long long view = (long long)agent * p.n_cameras + c;
        __syncwarp();
        for (int start = 0; start < R; start += batch) {
            int r = start + lane, on = lane < batch && r < R;
            Ray ray = {0.f, 0.f, 0.f, 0.f};
            if (on) {
                Nearest here = nearest[r];
                if (p.middle && r == R / 2) p.middle[view] = here.line;
                ray = shade_ray(p, screen, scene, camera, agent, view, r, here.inverse, here.line, fresh);
            }
            Ray sum = S == 4 ? sum_of(ray, 4) : sum_of(ray, S);     // the usual one unrolls
            __syncwarp();
            if (S == 1) { if (on) write_pixel(p, view, r, sum); }
            else if (on && leads) {         // over the pixel's own rays, which are done with: two of them take a Ray
                Nearest one = {sum.red, __float_as_int(sum.green)}, two = {sum.blue, __float_as_int(sum.depth)};
                nearest[r] = one; nearest[r + 1] = two;
            }
        }
        __syncwarp();
        if (S > 1)
            for (int pixel = lane; pixel < p.n_pixels; pixel += 32) {
                Nearest one = nearest[pixel * S], two = nearest[pixel * S + 1];
                Ray sum = {one.inverse, __int_as_float(one.line), two.inverse, __int_as_float(two.line)};
                write_pixel(p, view, pixel, sum);
            }
        __syncwarp();
    }
    if (p.fresh) {
        for (int step = 16; step; step /= 2) fresh += __shfl_xor_sync(~0u, fresh, step);
        if (lane == 0) p.fresh[agent] = fresh;
    }
}
