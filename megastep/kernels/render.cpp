// A loop over agents. Each line of a view is compared with the nearest so far at the pixels it
// covers. Then rays are shaded, in runs of neighbours that hit the same line.
#include <vector>

#include "common/errors.h"
#include "common/scenery.h"
#include "render.h"

// One thread's buffers: the projections of its lines, and one view.
struct Scratch {
    std::vector<Projection> projections;
    std::vector<float> inverse;
    std::vector<int> index;
    std::vector<RaySample> samples;
};

// Rasterises a near-clipped line, which is invisible where it is within the radius.
static void raster_near(Projection line, const RenderParams& p, int index, Scratch& scratch) {
    for (int r = line.span.first; r < line.span.end; r++) {
        float inverse = line.span.base + line.span.gain * (float)r;
        if (inverse > scratch.inverse[r] && inverse * p.scenery.radius < p.ray_lengths[r]) {
            scratch.inverse[r] = inverse;
            scratch.index[r] = index;
        }
    }
}

static void raster_span(PixelSpan span, int index, float* inverse, int* indices) {
#pragma omp simd
    for (int r = span.first; r < span.end; r++) {
        float here = span.base + span.gain * (float)r;
        int nearer = here > inverse[r];
        inverse[r] = nearer ? here : inverse[r];
        indices[r] = nearer ? index : indices[r];
    }
}

// Rasterises n lines except [skip_first, skip_end), the agent's own. `offset` is the index of the
// first line in the environment.
static void raster_lines(const Pose& camera, const Screen& screen, const RenderParams& p,
                         const float* lines, int n, int offset, int skip_first, int skip_end,
                         Scratch& scratch) {
    if ((int)scratch.projections.size() < n)
        scratch.projections.resize(n);
    Projection* projections = scratch.projections.data();
#pragma omp simd
    for (int l = 0; l < n; l++) {
        projections[l] = project(camera, screen, lines[4 * l], lines[4 * l + 1], lines[4 * l + 2],
                                 lines[4 * l + 3]);
    }
    for (int l = 0; l < n; l++) {
        Projection line = projections[l];
        if (line.span.first >= line.span.end || (l >= skip_first && l < skip_end))
            continue;
        if (line.near_clipped)
            raster_near(line, p, offset + l, scratch);
        else
            raster_span(line.span, offset + l, scratch.inverse.data(), scratch.index.data());
    }
}

static void shade_run(const RenderParams& p, const Screen& screen, const EnvScenery& scenery,
                      const Pose& camera, int view, unsigned int* seen, int first, int end,
                      Scratch& scratch, int& newly_seen) {
    Surface surface = surface_of<1>(p.scenery, scenery, camera, scratch.index[first]);
    for (int r = first; r < end; r++)
        scratch.samples[r] = shade_ray<1>(p, screen, scenery, surface, view, seen, r,
                                          scratch.inverse[r], newly_seen);
}

static void shade(const RenderParams& p, const Screen& screen, const EnvScenery& scenery,
                  const Pose& camera, int view, unsigned int* seen, Scratch& scratch,
                  int& newly_seen) {
    long long first_ray = (long long)view * p.res;
    int end;
    for (int first = 0; first < p.res; first = end) {
        int line = scratch.index[first];
        for (end = first + 1; end < p.res && scratch.index[end] == line; end++)
            ;
        if (p.indices)
            for (int r = first; r < end; r++)
                p.indices[first_ray + r] = line;
        if (line >= 0) {
            shade_run(p, screen, scenery, camera, view, seen, first, end, scratch, newly_seen);
            continue;
        }
        for (int r = first; r < end; r++) {
            scratch.samples[r] = {0.f, 0.f, 0.f, 0.f};
            write_miss(p, first_ray + r);
        }
    }
}

static void write_pixels(const RenderParams& p, int view, const RaySample* samples) {
    for (int pixel = 0; pixel < p.n_pixels; pixel++) {
        const RaySample* rays = samples + pixel * p.subsample;
        RaySample sum = rays[0];
        if (p.subsample == 4) {
            sum = plus(plus(rays[0], rays[1]), plus(rays[2], rays[3]));
        } else {
            for (int k = 1; k < p.subsample; k++)
                sum = plus(sum, rays[k]);
        }
        write_pixel(p, view, pixel, sum);
    }
}

// The ray closest to the central one that hits another agent, or the first of equals; -1: none.
static int agent_ray_of(const std::vector<int>& index, int n_agent_lines) {
    int res = (int)index.size(), best = -1, least = res;
    for (int r = 0; r < res; r++) {
        int off = r < res / 2 ? res / 2 - r : r - res / 2;
        if (index[r] >= 0 && index[r] < n_agent_lines && off < least) {
            best = r;
            least = off;
        }
    }
    return best;
}

static void render_view(const RenderParams& p, const EnvScenery& scenery, const Pose& camera,
                        int view, int a, unsigned int* seen, Scratch& scratch, int& newly_seen) {
    const SceneryParams& s = p.scenery;
    Screen screen = screen_of(p);
    scratch.inverse.assign(p.res, 0.f);
    scratch.index.assign(p.res, -1);
    if (s.n_agents > 1)
        raster_lines(camera, screen, p, scenery.agent_lines, scenery.n_agent_lines, 0,
                     a * s.n_model, (a + 1) * s.n_model, scratch);
    raster_lines(camera, screen, p, s.walls + 4 * (long long)scenery.first_wall, scenery.n_walls,
                 scenery.n_agent_lines, 0, 0, scratch);
    if (p.centre_line)
        p.centre_line[view] = scratch.index[p.res / 2];
    if (p.agent_ray)
        p.agent_ray[view] = agent_ray_of(scratch.index, scenery.n_agent_lines);
    shade(p, screen, scenery, camera, view, seen, scratch, newly_seen);
    write_pixels(p, view, scratch.samples.data());
}

static void render_agent(const RenderParams& p, int agent, Scratch& scratch) {
    const SceneryParams& s = p.scenery;
    int env = agent / s.n_agents, a = agent % s.n_agents;
    int newly_seen = 0;
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    EnvScenery scenery = env_scenery(s, env, layout_of(s, env, p.error_flag));
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
        render_view(p, scenery, camera, agent * p.n_cameras + c, a, seen, scratch, newly_seen);
    }
    if (p.newly_seen)
        p.newly_seen[agent] = newly_seen;
}

KERNEL render(const RenderParams& p) {
#pragma omp parallel num_threads(p.scenery.n_threads)
    {
        Scratch scratch;
        scratch.samples.resize(p.res);
#pragma omp for schedule(static)
        for (int agent = 0; agent < p.scenery.n_envs * p.scenery.n_agents; agent++)
            render_agent(p, agent, scratch);
    }
}
