// Rendering by warps, of an agent's cameras one after the other. A warp rasterises a camera's view;
// then each warp lane shades its rays, and neighbouring lanes sum theirs into pixels. If an agent
// `is_split`, the two warps of a block have half of each view.
//
// `render` is for many agents and for all outputs: one warp per agent, and so many warps per
// multiprocessor that 40 registers are left for each thread, which spills some. `unspilled`, for
// observations only, has fewer, with 64 registers per thread: faster until there are many agents.
// `split`, for few agents, has a block of two warps per agent, with 56 registers per thread. It
// takes whole tiles of 32 rays, so `subsample` must divide 32.
#include "raster_cuda.h"

// The sum over `n` warp lanes, in order: this one and those after it.
DEVICE RaySample sum_of(const RaySample& ray, int n) {
    RaySample sum = ray;
    for (int j = 1; j < n; j++) {
        sum.red += __shfl_down_sync(FULL_WARP, ray.red, j);
        sum.green += __shfl_down_sync(FULL_WARP, ray.green, j);
        sum.blue += __shfl_down_sync(FULL_WARP, ray.blue, j);
        sum.depth += __shfl_down_sync(FULL_WARP, ray.depth, j);
    }
    return sum;
}

// The sum over four neighbouring warp lanes, in pairs. Each lane returns one component: the first
// red, the next ones blue, green and depth.
DEVICE float quarter_of_sum(const RaySample& ray, int warp_lane) {
    int odd = warp_lane & 1, second = warp_lane & 2;
    float one = odd ? ray.blue : ray.red;
    float two = odd ? ray.depth : ray.green;
    one += __shfl_xor_sync(FULL_WARP, odd ? ray.red : ray.blue, 1);
    two += __shfl_xor_sync(FULL_WARP, odd ? ray.green : ray.depth, 1);
    return (second ? two : one) + __shfl_xor_sync(FULL_WARP, second ? one : two, 2);
}

// Where this warp draws objects: after the nearest lines in shared memory.
template <int drawn, int is_split>
DEVICE Float4* drawn_objects(const RenderParams& p, NearestLine* nearest) {
    if (!(drawn & OBJECTS))
        return 0;
    int warp = is_split ? threadIdx.x / WARP : 0;
    return (Float4*)(nearest + whole_tiles(p.res)) +
           warp * (p.objects.n_lines + p.objects.n_objects);
}

// Shades ray r of a camera, which hits one of the lines `hit` of those drawn.
template <int full_res, int drawn, int hit, int is_split>
DEVICE RaySample shade_hit(const RenderParams& p, const View<is_split>& v,
                           const EnvScenery& scenery, int view, unsigned int* seen, int r,
                           const NearestLine& nearest, int& newly_seen) {
    const Float4* objects = drawn_objects<hit, is_split>(p, v.nearest);
    Surface surface = surface_of<drawn, hit>(p, scenery, v.camera, nearest.line, objects);
    return shade_ray<full_res, hit>(p, v.screen, scenery, surface, objects, view, seen, r,
                                    nearest.inverse, newly_seen);
}

// Shades a camera's rays, one batch of warp lanes at a time, and sums them into pixels. Batches
// that hit no object are shaded as if there were none, which takes fewer instructions.
// `sees_objects`: 0 if none is hit.
template <int full_res, int drawn, int is_split>
DEVICE void shade(const RenderParams& p, const View<is_split>& v, const EnvScenery& scenery,
                  int view, unsigned int* seen, int sees_objects, int& newly_seen) {
    int subsample = p.subsample, warp_lane = v.warp_lane;
    int first = is_split ? TILE * v.tiles.first : 0;
    int res = is_split ? mini(p.res, TILE * v.tiles.end) : p.res;
    int batch = subsample == 4 ? WARP : WARP / subsample * subsample;
    int channel = (warp_lane & 1) << 1 | (warp_lane & 2) >> 1;  // of quarter_of_sum
    unsigned short* plane = channel == 3 ? p.depth : p.rgb;
    int wanted = plane != 0;
    plane += (long long)(channel == 3 ? view : 3 * view + channel) * p.n_pixels;
#pragma unroll 1
    for (int start = first; start < res; start += batch) {
        int r = start + warp_lane, active = r < res && warp_lane < batch;
        RaySample sample = {0.f, 0.f, 0.f, 0.f};
        int hits_objects = 0;
        if (drawn & OBJECTS && sees_objects)
            hits_objects = __any_sync(
                FULL_WARP, active && (unsigned int)(v.nearest[r].line - scenery.n_agent_lines) <
                                         (unsigned int)p.objects.n_lines);
        if (active) {
            NearestLine nearest = v.nearest[r];
            long long ray = (long long)view * p.res + r;
            if (full_res)
                p.indices[ray] = nearest.line;
            if (nearest.line >= 0) {
                if (drawn & OBJECTS && hits_objects)
                    sample = shade_hit<full_res, drawn, drawn>(p, v, scenery, view, seen, r,
                                                               nearest, newly_seen);
                else
                    sample = shade_hit<full_res, drawn, drawn & ~OBJECTS>(p, v, scenery, view, seen,
                                                                          r, nearest, newly_seen);
            } else if (full_res) {
                write_miss(p, ray);
            }
        }
        if (subsample == 4) {
            float sum = quarter_of_sum(sample, warp_lane);
            if (active && wanted)
                plane[r >> 2] = HALF_BITS(sum * p.inv_subsample);
        } else {
            RaySample sum = sum_of(sample, subsample);
            if (active && warp_lane % subsample == 0)
                write_pixel(p, view, r / subsample, sum);
        }
    }
}

// The ray closest to the central one that hits another agent, or the first of equals; -1: none.
DEVICE int agent_ray_of(const NearestLine* nearest, int res, int n_agent_lines, int warp_lane) {
    unsigned int best = ~0u;
    for (int r = warp_lane; r < res; r += WARP) {
        int line = nearest[r].line;
        if (line >= 0 && line < n_agent_lines)
            best = min(best, (unsigned int)(abs(r - res / 2) << 16 | r));
    }
    best = __reduce_min_sync(FULL_WARP, best);
    return best == ~0u ? -1 : (int)(best & 0xffffu);
}

template <int full_res, int drawn, int is_split>
DEVICE void render_agent(const RenderParams& p, int agent, int warp_lane, PixelSpan* spans,
                         NearestLine* nearest, int* newly_seen_by_warp) {
    if (p.only && !p.only[agent])
        return;
    const SceneryParams& s = p.scenery;
    int warp = threadIdx.x / WARP;
    int rank = is_split ? threadIdx.x : warp_lane, n_threads = is_split ? BLOCK : WARP;
    int env = drawn & AGENTS ? agent / s.n_agents : agent,
        a = drawn & AGENTS ? agent % s.n_agents : 0;
    int newly_seen = 0;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    Screen screen = screen_of(p);
    int layout = layout_of(s, env, p.error_flag);
    EnvScenery scenery = env_scenery(s, env, layout);
    unsigned int* seen = p.seen ? p.seen + agent * (long long)p.n_words : 0;
    if (rank == 0)
        flag_nonfinite(p.error_flag, env, x, y, angle);
    if (p.imu && rank < 3)
        write_imu(p, agent, rank);
    if (seen && p.clear_mask && p.clear_mask[agent])
        for (int i = rank; i < p.n_words; i += n_threads)
            seen[i] = 0u;
    Range tiles = {0, 0};
    if (is_split) {
        tiles = half_of_screen(p.res, warp);
        __syncthreads();  // `seen` is clear
    }
    if (drawn & OBJECTS && warp_lane < p.objects.n_objects)  // needed after the walls
        PREFETCH(objects_of(p.objects) + env * p.objects.n_objects + warp_lane);
    int reads_both = is_split && (p.centre_line || p.agent_ray);  // halves of `nearest`
    for (int c = 0; c < p.n_cameras; c++) {
        int view = agent * p.n_cameras + c;
        Pose camera = pose_at(x, y, angle + p.yaws[c]);
        View<is_split> v = {camera, screen, p.ray_lengths, spans, nearest, warp_lane, tiles, 0.f};
        clear(v);
        if (drawn & AGENTS && s.n_agents > 1)
            raster_agents(v, s, scenery, a);
        raster_walls<drawn>(v, p, scenery, p.half_width);
        int sees_objects = 0;
        if (drawn & OBJECTS)
            sees_objects = raster_objects(v, p, scenery, env, layout, a,
                                          drawn_objects<drawn, is_split>(p, nearest));
        __syncwarp();
        if (reads_both)
            __syncthreads();
        if (p.centre_line && rank == 0)
            p.centre_line[view] = nearest[p.res / 2].line;
        if (p.agent_ray && rank == warp_lane) {
            int ray = -1;
            if (drawn & AGENTS)
                ray = agent_ray_of(nearest, p.res, scenery.n_agent_lines, warp_lane);
            if (warp_lane == 0)
                p.agent_ray[view] = ray;
        }
        if (reads_both)
            __syncthreads();
        shade<full_res, drawn>(p, v, scenery, view, seen, sees_objects, newly_seen);
    }
    if (!p.newly_seen)
        return;
    newly_seen = __reduce_add_sync(FULL_WARP, newly_seen);
    if (is_split) {
        if (warp_lane == 0)
            newly_seen_by_warp[warp] = newly_seen;
        __syncthreads();
        newly_seen = newly_seen_by_warp[0] + newly_seen_by_warp[1];
    }
    if (rank == 0)
        p.newly_seen[agent] = newly_seen;
}

// One warp per agent. Three variants: all outputs, several agents, one agent. The last needs the
// fewest registers. With objects there are the same three.
template <int may_write_all, int with_objects = 0>
DEVICE void render_by_warps(const RenderParams& p) {
    extern __shared__ NearestLine shared[];
    __shared__ PixelSpan spans[BLOCK];
    int warp = threadIdx.x / WARP, warp_lane = threadIdx.x % WARP;
    int agent = blockIdx.x * (BLOCK / WARP) + warp;
    if (agent >= p.scenery.n_envs * p.scenery.n_agents)
        return;
    PixelSpan* warp_spans = spans + WARP * warp;
    NearestLine* nearest = shared + whole_tiles(p.res) * warp;
    if (with_objects)  // whose lines and texels follow
        nearest += 2 * (p.objects.n_lines + p.objects.n_objects) * warp;
    constexpr int objects = with_objects ? OBJECTS : 0;
    if (may_write_all && p.indices)
        render_agent<1, AGENTS | objects, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
    else if (p.scenery.n_agents > 1)
        render_agent<0, AGENTS | objects, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
    else
        render_agent<0, objects, 0>(p, agent, warp_lane, warp_spans, nearest, 0);
}

static_assert(BLOCK == 2 * WARP, "each of two warps has half_of_screen");

template <int with_objects>
DEVICE void render_halves(const RenderParams& p) {
    extern __shared__ NearestLine nearest[];
    __shared__ PixelSpan spans[BLOCK];
    __shared__ int newly_seen_by_warp[BLOCK / WARP];
    int warp_lane = threadIdx.x % WARP;
    PixelSpan* warp_spans = spans + (threadIdx.x - warp_lane);
    if (p.scenery.n_agents > 1)
        render_agent<0, AGENTS | with_objects, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                                  newly_seen_by_warp);
    else
        render_agent<0, with_objects, 1>(p, blockIdx.x, warp_lane, warp_spans, nearest,
                                         newly_seen_by_warp);
}

INSTANCE(BOUNDS(24) render, RenderParams, render_by_warps<1>)
INSTANCE(BOUNDS(24) render_objects, RenderParams, render_by_warps<1, 1>)
INSTANCE(BOUNDS(16) render_unspilled, RenderParams, render_by_warps<0>)
INSTANCE(BOUNDS(16) render_objects_unspilled, RenderParams, render_by_warps<0, 1>)
INSTANCE(BOUNDS(18) render_split, RenderParams, render_halves<0>)
INSTANCE(BOUNDS(18) render_objects_split, RenderParams, render_halves<OBJECTS>)
