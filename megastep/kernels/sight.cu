// One warp an agent, its cameras one after the other. Walls stand in groups of 32 with a box around each: groups that cannot be seen are left out, the others come
// nearest first. Lanes take a wall each, find the pixels it covers and lay that down in shared memory; then the warp goes over the blocks of 32 pixels that the group
// covers, over each block's walls, a pixel a lane, and keeps the largest inverse depth and, of equals, the first line. Walls wholly behind what a block shows already are
// passed over. Then each lane shades its rays, and neighbours add theirs up into pixels.

struct __align__(16) Covered { int first, last; float base, gain; };      // a wall's pixels [first, last), and its inverse depth at pixel r: base + gain r
struct __align__(8) Nearest { float inverse; int line; };

// A warp's view in the making. `nearest` has whole blocks: pixels beyond the screen are at INFINITE. Lane k knows `floor`, the smallest inverse depth in block k.
struct View { const Camera& camera; const Screen& screen; const float* lengths; Covered* covered; Nearest* nearest; int lane; float floor; };

DEVICE void clear(View& v) {
    __syncwarp();
    for (int r = v.lane; r < (v.screen.res + 31 & ~31); r += 32) {
        Nearest nothing = {r < v.screen.res ? 0.f : INFINITE, -1};
        v.nearest[r] = nothing;
    }
    v.floor = 0.f;
}

// 32 lines at once, one a lane; `on` where there is one. `line` is the number in the world of the first lane's.
DEVICE void raster_group(View& v, const Four_floats* ends, int line, int on) {
    Span span = {0, 0, 0.f, 0.f, 0};
    if (on) {
        Four_floats b = LOAD(ends);
        span = span_of(v.camera, v.screen, b.x, b.y, b.z, b.w);
    }
    int visible = span.first < span.last, from = visible ? span.first >> 5 : 32, to = visible ? (span.last - 1) >> 5 : -1;
    float most = high(span.base + span.gain * (float)span.first, span.base + span.gain * (float)(span.last - 1));
    unsigned int close = __ballot_sync(~0u, span.close);
    Covered mine = {span.first, span.last, span.base, span.gain};
    __syncwarp();
    v.covered[v.lane] = mine;
    __syncwarp();
    int end = __reduce_max_sync(~0u, to);
    #pragma unroll 1
    for (int k = __reduce_min_sync(~0u, from); k <= end; k++) {
        float floor = __shfl_sync(~0u, v.floor, k);
        unsigned int some = __ballot_sync(~0u, from <= k && k <= to && most >= floor);
        if (!some) continue;
        int r = 32 * k + v.lane, slot = 0;
        float at = (float)r, inverse = 0.f;
        #pragma unroll 1
        for (unsigned int left = some & ~close; left;) {        // downwards, so that of equals the first comes last
            int i = 31 - __clz(left);
            Covered one = v.covered[i];
            float here = one.base + one.gain * at;
            if (r >= one.first && r < one.last && here >= inverse) { inverse = here; slot = i; }
            left ^= 1u << i;
        }
        #pragma unroll 1
        for (unsigned int left = some & close; left; left &= left - 1) {       // where they come within the radius they are not seen
            int i = __ffs(left) - 1;
            Covered one = v.covered[i];
            float here = one.base + one.gain * at;
            if (r >= one.first && r < one.last && here * v.screen.radius < v.lengths[r] && (here > inverse || (here == inverse && i < slot))) {
                inverse = here; slot = i;
            }
        }
        Nearest there = v.nearest[r];
        if (inverse > there.inverse || (inverse == there.inverse && line + slot < there.line)) {
            there.inverse = inverse; there.line = line + slot;
            v.nearest[r] = there;
        }
        unsigned int lowest = __reduce_min_sync(~0u, __float_as_uint(there.inverse));
        if (v.lane == k) v.floor = __uint_as_float(lowest);
    }
}

DEVICE void raster_walls(View& v, const World& w, const Scene& scene, int design, float half_width) {
    int first_box = w.box_starts[design];
    for (int start = 0; 32 * start < scene.n_walls; start += 32) {
        unsigned int key = ~0u;
        Cover cover = {-1.f, 0.f, 0, 0};
        if (32 * (start + v.lane) < scene.n_walls) {
            float4 b = ((const float4*)w.boxes)[first_box + start + v.lane];
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
            int l = 32 * (start + k);
            raster_group(v, (const Four_floats*)w.walls + (scene.first_wall + l + v.lane), scene.n_agent_lines + l, l + v.lane < scene.n_walls);
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

// The sum over four neighbouring lanes, by pairs. Each is left with one of its numbers: the first lane red, then blue, green, depth.
DEVICE float quarter_of_sum(const Ray& ray, int lane) {
    int odd = lane & 1, second = lane & 2;
    float one = (odd ? ray.blue : ray.red) + __shfl_xor_sync(~0u, odd ? ray.red : ray.blue, 1);
    float two = (odd ? ray.depth : ray.green) + __shfl_xor_sync(~0u, odd ? ray.green : ray.depth, 1);
    return (second ? two : one) + __shfl_xor_sync(~0u, second ? one : two, 2);
}

// Shades a view's rays, a batch of lanes at a time, and adds them up into pixels.
template <int whole, int crowd>
DEVICE void shade(const Sight& p, const View& v, const Scene& scene, int view, unsigned int* seen, int& fresh) {
    int R = p.res, S = p.subsample, lane = v.lane, batch = S == 4 ? 32 : 32 / S * S, channel = (lane & 1) << 1 | (lane & 2) >> 1;
    unsigned short* plane = channel == 3 ? p.depth : p.rgb;
    int wanted = plane != 0;
    plane += (long long)(channel == 3 ? view : 3 * view + channel) * p.n_pixels;
    #pragma unroll 1
    for (int start = 0; start < R; start += batch) {
        int r = start + lane, on = r < R && lane < batch;
        Ray ray = {0.f, 0.f, 0.f, 0.f};
        if (on) {
            Nearest here = v.nearest[r];
            long long place = (long long)view * R + r;
            if (whole) p.indices[place] = here.line;
            if (here.line >= 0) {
                Surface surface = surface_of<crowd>(p.world, scene, v.camera, here.line);
                ray = shade_ray<whole>(p, v.screen, scene, surface, view, seen, r, here.inverse, fresh);
            } else if (whole) miss_ray(p, place);
        }
        if (S == 4) {
            float sum = quarter_of_sum(ray, lane);
            if (on && wanted) plane[r >> 2] = HALF_BITS(sum * p.share);
        } else {
            Ray sum = sum_of(ray, S);
            if (on && lane % S == 0) write_pixel(p, view, r / S, sum);
        }
    }
}

template <int whole, int crowd>
DEVICE void look(const Sight& p, int agent, int lane, Covered* covered, Nearest* nearest) {
    const World& w = p.world;
    int world = crowd ? agent / w.n_agents : agent, a = crowd ? agent % w.n_agents : 0, fresh = 0;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    Screen screen = screen_of(p);
    Scene scene = scene_of(w, world);
    unsigned int* seen = p.seen ? p.seen + agent * (long long)p.n_words : 0;
    if (lane == 0) notice(p.fault, world, x, y, angle);
    if (p.imu && lane < 3) feel(p, agent, lane);
    if (seen && p.forget && p.forget[agent])
        for (int i = lane; i < p.n_words; i += 32) seen[i] = 0u;
    for (int c = 0; c < p.n_cameras; c++) {
        int view = agent * p.n_cameras + c;
        Camera camera = camera_at(x, y, angle + p.yaws[c]);
        View v = {camera, screen, p.ray_lengths, covered, nearest, lane, 0.f};
        clear(v);
        if (crowd && w.n_agents > 1)
            for (int l = 0; l < scene.n_agent_lines; l += 32)
                raster_group(v, (const Four_floats*)scene.agent_lines + (l + lane), l, l + lane < scene.n_agent_lines && (l + lane) / w.n_model != a);
        raster_walls(v, w, scene, w.design[world], p.half_width);
        __syncwarp();
        if (p.middle && lane == 0) p.middle[view] = nearest[p.res / 2].line;
        shade<whole, crowd>(p, v, scene, view, seen, fresh);
    }
    if (!p.fresh) return;
    fresh = __reduce_add_sync(~0u, fresh);
    if (lane == 0) p.fresh[agent] = fresh;
}

KERNEL BOUNDS sight(Sight p) {
    extern __shared__ Nearest shared[];
    __shared__ Covered covered[64];
    int warp = threadIdx.x / 32, lane = threadIdx.x % 32, agent = blockIdx.x * 2 + warp;
    if (agent >= p.world.n_worlds * p.world.n_agents) return;
    Nearest* nearest = shared + (p.res + 31 & ~31) * warp;
    if (p.indices) look<1, 1>(p, agent, lane, covered + 32 * warp, nearest);
    else if (p.world.n_agents > 1) look<0, 1>(p, agent, lane, covered + 32 * warp, nearest);
    else look<0, 0>(p, agent, lane, covered + 32 * warp, nearest);
}
