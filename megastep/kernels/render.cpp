// A loop over agents. Each line of a view is compared with the nearest so far at the pixels it
// covers. Then all rays are shaded together: their surfaces, hits and samples, loop after loop.
#include <algorithm>
#include <vector>

#include "render.h"

// Four floats in one register, as a texel (red, green, blue, light) or a ray's sample (red, green,
// blue, depth).
typedef float Four __attribute__((vector_size(16)));
typedef float AnyFour __attribute__((vector_size(16), aligned(4), may_alias));

// Loops over rays are in blocks of so many, since compilers then need no code for the last few.
constexpr int BLOCK_RAYS = 16;

// Neighbouring rays [first, end) that hit the same line; -1: none.
struct Run {
    int line, first, end;
};

// The rays of a view, one array per field, so that compilers vectorise loops over them.
struct Rays {
    // the nearest line
    std::vector<float> inverse, ax, ay, vx, vy;
    std::vector<int> index, first_texel, width;
    // where they hit it: `texel` as seen, and `left`, `right` and `weight` of the filter
    std::vector<float> location, facing, weight, distance, depth;
    std::vector<int> texel, left, right;
    std::vector<Four> samples;
    std::vector<Run> runs;

    explicit Rays(int res) : samples(res) {
        int size = (res + BLOCK_RAYS - 1) / BLOCK_RAYS * BLOCK_RAYS;
        for (auto* field :
             {&inverse, &ax, &ay, &vx, &vy, &location, &facing, &weight, &distance, &depth})
            field->resize(size);
        for (auto* field : {&index, &first_texel, &width, &texel, &left, &right})
            field->resize(size);
    }
};

struct Projections {
    std::vector<int> first, end, near_clipped;
    std::vector<float> base, gain;

    void resize(int n) {
        for (auto* field : {&first, &end, &near_clipped})
            field->resize(n);
        for (auto* field : {&base, &gain})
            field->resize(n);
    }
};

// One thread's buffers: the projections of its lines, and one view.
struct Scratch {
    Projections projections;
    std::vector<int> visible;
    std::vector<float> sums;
    std::vector<unsigned short> halves;
    Rays rays;
    std::vector<Float4> objects;
};

// Rasterises a near-clipped line, which is invisible where it is within the radius.
static void raster_near(PixelSpan span, const RenderParams& p, int index, Rays& rays) {
    for (int r = span.first; r < span.end; r++) {
        float inverse = span.base + span.gain * (float)r;
        if (inverse > rays.inverse[r] && inverse * p.scenery.radius < p.ray_lengths[r]) {
            rays.inverse[r] = inverse;
            rays.index[r] = index;
        }
    }
}

static void raster_span(PixelSpan span, int index, float* inverse, int* indices) {
    for (int block = span.first / BLOCK_RAYS * BLOCK_RAYS; block < span.end; block += BLOCK_RAYS) {
#pragma omp simd
        for (int i = 0; i < BLOCK_RAYS; i++) {
            int r = block + i;
            float here = span.base + span.gain * (float)r;
            int nearer = (here > inverse[r]) & (r >= span.first) & (r < span.end);
            inverse[r] = nearer ? here : inverse[r];
            indices[r] = nearer ? index : indices[r];
        }
    }
}

// Rasterises n lines except those for which `is_skipped(line)`. `offset` is the index of the first
// line in the environment.
template <class IsSkipped>
static void raster_lines(const Pose& camera, const Screen& screen, const RenderParams& p,
                         const float* lines, int n, int offset, IsSkipped is_skipped,
                         Scratch& scratch) {
    Projections& spans = scratch.projections;
    if ((int)scratch.visible.size() < n) {
        spans.resize(n);
        scratch.visible.resize(n);
    }
    int *firsts = spans.first.data(), *ends = spans.end.data(), *nears = spans.near_clipped.data();
    float *bases = spans.base.data(), *gains = spans.gain.data();
    Pose pose = camera;
    Screen lens = screen;
#pragma GCC ivdep
    for (int l = 0; l < n; l++) {
        Projection line =
            project(pose, lens, lines[4 * l], lines[4 * l + 1], lines[4 * l + 2], lines[4 * l + 3]);
        firsts[l] = line.span.first;
        ends[l] = line.span.end;
        bases[l] = line.span.base;
        gains[l] = line.span.gain;
        nears[l] = line.near_clipped;
    }
    int n_visible = 0;
    for (int l = 0; l < n; l++) {
        scratch.visible[n_visible] = l;
        n_visible += firsts[l] < ends[l];
    }
    for (int i = 0; i < n_visible; i++) {
        int l = scratch.visible[i];
        if (is_skipped(l))
            continue;
        PixelSpan span = {firsts[l], ends[l], bases[l], gains[l]};
        if (nears[l])
            raster_near(span, p, offset + l, scratch.rays);
        else
            raster_span(span, offset + l, scratch.rays.inverse.data(), scratch.rays.index.data());
    }
}

static void find_runs(const std::vector<int>& index, int res, std::vector<Run>& runs) {
    runs.clear();
    int end;
    for (int first = 0; first < res; first = end) {
        for (end = first + 1; end < res && index[end] == index[first]; end++)
            ;
        runs.push_back({index[first], first, end});
    }
}

static void find_surfaces(const RenderParams& p, const EnvScenery& scenery, const Float4* objects,
                          const Pose& camera, Rays& rays) {
    for (auto [line, first, end] : rays.runs) {
        Surface surface = {0.f, 0.f, 0.f, 0.f, 0, 1, 0};
        if (line >= 0)
            surface = surface_of<AGENTS | OBJECTS>(p, scenery, camera, line, objects);
        int n = end - first;
        std::fill_n(&rays.ax[first], n, surface.ax);
        std::fill_n(&rays.ay[first], n, surface.ay);
        std::fill_n(&rays.vx[first], n, surface.vx);
        std::fill_n(&rays.vy[first], n, surface.vy);
        std::fill_n(&rays.first_texel[first], n, surface.first_texel);
        std::fill_n(&rays.width[first], n, surface.width);
    }
}

// What a ray without a line gets here is never read. GCC 12 vectorises the loop only with addresses
// in variables, and not with "omp simd", which keeps structs in memory.
static void find_hits(const RenderParams& p, const Screen& screen, Rays& rays) {
    const float *ax = rays.ax.data(), *ay = rays.ay.data(), *vx = rays.vx.data(),
                *vy = rays.vy.data(), *inverse = rays.inverse.data(), *lengths = p.ray_lengths;
    const int *firsts = rays.first_texel.data(), *widths = rays.width.data();
    float *location = rays.location.data(), *facing = rays.facing.data(),
          *weight = rays.weight.data(), *distance = rays.distance.data(),
          *depth = rays.depth.data(), inv_max_depth = p.inv_max_depth;
    int *texel = rays.texel.data(), *left = rays.left.data(), *right = rays.right.data();
    int res = p.res;
    Screen lens = screen;
#pragma GCC ivdep
    for (int r = 0; r < res; r++) {
        float y = ray_slope(lens, r), length = lengths[r];
        int first = firsts[r], width = widths[r];
        Hit hit = hit_of({ax[r], ay[r], vx[r], vy[r], first, width, 0}, y, length);
        Filter filter = filter_at(hit.location, width);
        location[r] = hit.location;
        facing[r] = hit.facing;
        texel[r] = first + texel_at(hit.location, width);
        left[r] = first + filter.left;
        right[r] = first + filter.right;
        weight[r] = filter.weight;
        distance[r] = length * RECIPROCAL(inverse[r]);
        depth[r] = depth_reading(distance[r], lens.radius, inv_max_depth);
    }
}

// As colour_at, with a vector of all components.
static void wall_samples(const void* of, Rays& rays, int first, int end) {
    const AnyFour* texels = (const AnyFour*)of;
    const int *left = rays.left.data(), *right = rays.right.data();
    const float *weight = rays.weight.data(), *facing = rays.facing.data();
    const float* depth = rays.depth.data();
    Four* samples = rays.samples.data();
    for (int r = first; r < end; r++) {
        Four texel = texels[left[r]];
        texel += weight[r] * (texels[right[r]] - texel);
        Four sample = texel * (texel[3] * facing[r]);
        sample[3] = depth[r];
        samples[r] = sample;
    }
}

static void agent_samples(const EnvScenery& scenery, Rays& rays, int first, int end) {
    for (int r = first; r < end; r++) {
        Colour colour = blend(agent_texel(scenery, rays.left[r]),
                              agent_texel(scenery, rays.right[r]), rays.weight[r], rays.facing[r]);
        rays.samples[r] = Four{colour.red, colour.green, colour.blue, rays.depth[r]};
    }
}

static void find_samples(const RenderParams& p, const EnvScenery& scenery, const Float4* objects,
                         Rays& rays) {
    for (auto [line, first, end] : rays.runs) {
        if (line < 0)
            std::fill_n(&rays.samples[first], end - first, Four{});
        else if (line < scenery.n_agent_lines)
            agent_samples(scenery, rays, first, end);
        else if (line < first_static_line<OBJECTS>(p, scenery))
            wall_samples(objects + p.objects.n_lines, rays, first, end);
        else
            wall_samples(p.scenery.texels, rays, first, end);
    }
}

// Returns the number of newly seen texels. Nearly all were seen before, so blocks of rays are
// tested for others first.
static int mark_all_seen(const RenderParams& p, const EnvScenery& scenery, Rays& rays,
                         unsigned int* seen) {
    int newly_seen = 0, first_line = first_static_line<OBJECTS>(p, scenery);
    int first_texel = scenery.first_texel;
    const int *index = rays.index.data(), *texel = rays.texel.data();
    for (int block = 0; block < (int)rays.index.size(); block += BLOCK_RAYS) {
        unsigned int unseen = 0;
#pragma omp simd reduction(| : unseen)
        for (int i = 0; i < BLOCK_RAYS; i++) {
            int r = block + i, at = texel[r] - first_texel;
            if (index[r] >= first_line)
                unseen |= ~seen[at >> 5] & 1u << (at & 31);
        }
        for (int r = block; unseen && r < block + BLOCK_RAYS; r++)
            if (index[r] >= first_line)
                newly_seen += mark_seen(seen, texel[r] - first_texel);
    }
    return newly_seen;
}

static void write_rays(const RenderParams& p, const Screen& screen, int view, const Rays& rays) {
    for (int r = 0; r < p.res; r++) {
        long long ray = (long long)view * p.res + r;
        if (p.indices)
            p.indices[ray] = rays.index[r];
        if (rays.index[r] < 0) {
            write_miss(p, ray);
            continue;
        }
        if (p.screen)
            for (int k = 0; k < 3; k++)
                p.screen[3 * ray + k] = rays.samples[r][k];
        if (p.locations)
            p.locations[ray] = rays.location[r];
        if (p.dots)
            p.dots[ray] = cosine_of({0.f, 0.f, rays.vx[r], rays.vy[r], 0, 0, 0},
                                    ray_slope(screen, r), p.ray_lengths[r]);
        if (p.distances)
            p.distances[ray] = rays.distance[r];
    }
}

// As write_pixel.
static void write_pixels(const RenderParams& p, int view, const std::vector<Four>& samples,
                         Scratch& scratch) {
    int n = p.n_pixels;
    scratch.sums.resize(4 * n);
    scratch.halves.resize(4 * n);
    for (int pixel = 0; pixel < n; pixel++) {
        const Four* rays = samples.data() + pixel * p.subsample;
        Four sum = rays[0];
        if (p.subsample == 4) {
            sum = (rays[0] + rays[1]) + (rays[2] + rays[3]);
        } else {
            for (int k = 1; k < p.subsample; k++)
                sum += rays[k];
        }
        for (int k = 0; k < 4; k++)
            scratch.sums[k * n + pixel] = sum[k];
    }
    const float* sums = scratch.sums.data();
    unsigned short* halves = scratch.halves.data();
#pragma omp simd
    for (int i = 0; i < 4 * n; i++)
        halves[i] = HALF_BITS(sums[i] * p.inv_subsample);
    if (p.rgb)
        std::copy(halves, halves + 3 * n, p.rgb + (long long)view * (3 * n));
    if (p.depth)
        std::copy(halves + 3 * n, halves + 4 * n, p.depth + (long long)view * n);
}

// The ray closest to the central one that hits another agent, or the first of equals; -1: none.
static int agent_ray_of(const std::vector<int>& index, int res, int n_agent_lines) {
    int best = -1, least = res;
    for (int r = 0; r < res; r++) {
        int off = r < res / 2 ? res / 2 - r : r - res / 2;
        if (index[r] >= 0 && index[r] < n_agent_lines && off < least) {
            best = r;
            least = off;
        }
    }
    return best;
}

// Returns the number of newly seen texels.
static int render_view(const RenderParams& p, const EnvScenery& scenery, const Pose& camera,
                       int view, int a, unsigned int* seen, Scratch& scratch) {
    const SceneryParams& s = p.scenery;
    Screen screen = screen_of(p);
    Rays& rays = scratch.rays;
    std::fill(rays.inverse.begin(), rays.inverse.end(), 0.f);
    std::fill(rays.index.begin(), rays.index.end(), -1);
    if (s.n_agents > 1)
        raster_lines(
            camera, screen, p, scenery.agent_lines, scenery.n_agent_lines, 0,
            [&](int l) { return l / s.n_model == a; }, scratch);
    const Float4* objects = scratch.objects.data();
    raster_lines(
        camera, screen, p, (const float*)objects, p.objects.n_lines, scenery.n_agent_lines,
        [](int) { return false; }, scratch);
    raster_lines(
        camera, screen, p, s.walls + 4 * (long long)scenery.first_wall, scenery.n_walls,
        first_static_line<OBJECTS>(p, scenery), [](int) { return false; }, scratch);
    if (p.centre_line)
        p.centre_line[view] = rays.index[p.res / 2];
    if (p.agent_ray)
        p.agent_ray[view] = agent_ray_of(rays.index, p.res, scenery.n_agent_lines);
    find_runs(rays.index, p.res, rays.runs);
    find_surfaces(p, scenery, objects, camera, rays);
    find_hits(p, screen, rays);
    if (p.rgb || p.screen || p.depth)
        find_samples(p, scenery, objects, rays);
    if (p.indices || p.screen || p.locations || p.dots || p.distances)
        write_rays(p, screen, view, rays);
    if (p.rgb || p.depth)
        write_pixels(p, view, rays.samples, scratch);
    return seen ? mark_all_seen(p, scenery, rays, seen) : 0;
}

static void render_agent(const RenderParams& p, int agent, Scratch& scratch) {
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, a = agent % s.n_agents;
    int newly_seen = 0;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    int layout = layout_of(s, env, p.error_flag);
    EnvScenery scenery = env_scenery(s, env, layout);
    scratch.objects.resize(p.objects.n_lines + p.objects.n_objects);
    for (int k = 0; k < p.objects.n_objects; k++) {
        Object object = object_at(p, env, k);
        if (a == 0)
            settle(p.objects, s, object, layout, env * p.objects.n_objects + k, p.error_flag);
        draw_texel(p, object, env, k, scratch.objects.data());
        Range lines = lines_of(p.objects, k);
        for (int l = lines.first; l < lines.end; l++)
            scratch.objects[l] = seen_line(p.objects, object, l, a);
    }
    unsigned int* seen = p.seen ? p.seen + agent * (long long)p.n_words : nullptr;
    flag_nonfinite(p.error_flag, env, x, y, angle);
    if (p.imu)
        for (int k = 0; k < 3; k++)
            write_imu(p, agent, k);
    if (seen && p.clear_mask && p.clear_mask[agent])
        for (int i = 0; i < p.n_words; i++)
            seen[i] = 0u;
    for (int c = 0; c < p.n_cameras; c++) {
        Pose camera = pose_at(x, y, angle + p.yaws[c]);
        newly_seen += render_view(p, scenery, camera, agent * p.n_cameras + c, a, seen, scratch);
    }
    if (p.newly_seen)
        p.newly_seen[agent] = newly_seen;
}

KERNEL render(const RenderParams& p) {
#pragma omp parallel num_threads(p.scenery.n_threads)
    {
        Scratch scratch = {{}, {}, {}, {}, Rays(p.res), {}};
#pragma omp for schedule(static)
        for (int agent = 0; agent < p.scenery.n_envs * p.scenery.n_agents; agent++)
            if (!p.only || p.only[agent])
                render_agent(p, agent, scratch);
    }
}

KERNEL render_objects(const RenderParams& p) { render(p); }
