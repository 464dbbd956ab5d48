// The CPU backend: each operation as a loop over worlds or agents, shared among threads; inner loops over walls and pixels are written so that compilers vectorise them.
#include <vector>
#define HD static inline
#define ALIGNED
#define SQRT(x) __builtin_sqrtf(x)
#define CEIL(x) __builtin_ceilf(x)
#define FLOOR(x) __builtin_floorf(x)
#define RINT(x) __builtin_rintf(x)
#define RECIPROCAL(x) (1.f / (x))
#define LOAD(at) (*(at))
#define NAN_VALUE __builtin_nanf("")
#define INFINITE __builtin_inff()
static inline unsigned int or_bits(unsigned int* word, unsigned int bits) { unsigned int old = *word; *word = old | bits; return old; }
#define OR_BITS(word, bits) or_bits(word, bits)
// IEEE round to nearest even, on bits, so that it needs no instruction that some processors lack.
static inline unsigned short half_bits(float value) {
    union { float f; unsigned int u; } in; in.f = value;
    unsigned int sign = (in.u >> 16) & 0x8000u, magnitude = in.u & 0x7fffffffu;
    if (magnitude > 0x7f800000u) return (unsigned short)(sign | 0x7e00u);               // NaN
    if (magnitude >= 0x477ff000u) return (unsigned short)(sign | 0x7c00u);              // rounds beyond 65504
    if (magnitude < 0x38800000u) {                                                      // subnormal: a float addition does the rounding
        union { float f; unsigned int u; } small; small.u = magnitude;
        small.f += 0.5f;
        return (unsigned short)(sign | (small.u - 0x3f000000u));
    }
    return (unsigned short)(sign | ((magnitude - 0x38000000u + 0xfffu + ((magnitude >> 13) & 1u)) >> 13));
}
#define HALF_BITS(x) half_bits(x)
#include "params.h"
#include "math.h"
#include "scene.h"

// Is the path from a light hidden by any of these walls?
static int hidden_by(const float* walls, int n, float lx, float ly, float dx, float dy) {
    for (int start = 0; start < n; start += 64) {
        int end = start + 64 < n ? start + 64 : n, any = 0;
        #pragma omp simd reduction(| : any)
        for (int j = start; j < end; j++) any |= blocks(blind_of(lx, ly, walls[4 * j], walls[4 * j + 1], walls[4 * j + 2], walls[4 * j + 3]), dx, dy);
        if (any) return 1;
    }
    return 0;
}

static float light_at(const World& w, int design, float x, float y) {
    float sum = AMBIENT;
    int first = w.wall_starts[design], n = w.wall_starts[design + 1] - first;
    for (int l = w.light_starts[design]; l < w.light_starts[design + 1]; l++) {
        const float* light = w.lights + 3 * l;
        float dx = x - light[0], dy = y - light[1];
        if (!hidden_by(w.walls + 4 * (long long)first, n, light[0], light[1], dx, dy)) sum += glow(light[2], dx, dy);
    }
    return low(sum, 1.f);
}

extern "C" void bake(const Bake* given) {
    const Bake& p = *given;
    const World& w = p.world;
    #pragma omp parallel for schedule(dynamic, 256) num_threads(w.n_threads)
    for (int texel = 0; texel < p.n_texels; texel++) {
        int wall = p.texel_wall[texel], first = w.texel_starts[wall], width = w.texel_starts[wall + 1] - first;
        float u = ((float)(texel - first) + 0.5f) / (float)width;
        const float* line = w.walls + 4 * (long long)wall;
        w.texels[4 * (long long)texel + 3] = light_at(w, p.wall_design[wall], mix(line[0], line[2], u), mix(line[1], line[3], u));
    }
}

extern "C" void physics(const Motion* given) {
    const Motion& p = *given;
    const World& w = p.world;
    int A = w.n_agents;
    float rho = w.radius * INFLATION;
    #pragma omp parallel num_threads(w.n_threads)
    {
        std::vector<unsigned char> meets;
        #pragma omp for schedule(static)
        for (int world = 0; world < w.n_worlds; world++) {
            int design = w.design[world], n = w.wall_starts[design + 1] - w.wall_starts[design];
            const float* walls = w.walls + 4 * (long long)w.wall_starts[design];
            if (p.actions) for (int a = 0; a < A; a++) steer(p, world, a);
            if ((int)meets.size() < n) meets.resize(n);
            unsigned char* meet = meets.data();
            for (int a = 0; a < A; a++) {
                int i = world * A + a;
                float px = p.positions[2 * i], py = p.positions[2 * i + 1];
                float dx = stride(px, p.velocity[2 * i], p.seconds), dy = stride(py, p.velocity[2 * i + 1], p.seconds), contact = NO_CONTACT;
                if (dx != 0.f || dy != 0.f) {
                    #pragma omp simd
                    for (int j = 0; j < n; j++)
                        meet[j] = (unsigned char)boxes_meet(px, py, dx, dy, walls[4 * j], walls[4 * j + 1], walls[4 * j + 2], walls[4 * j + 3], rho);
                    for (int j = 0; j < n; j++)
                        if (meet[j]) contact = low(contact, sweep_segment(px, py, dx, dy, walls[4 * j], walls[4 * j + 1], walls[4 * j + 2], walls[4 * j + 3], rho));
                }
                for (int k = world * A; k < world * A + A; k++)
                    if (k != i)
                        contact = low(contact, sweep_point(px - p.positions[2 * k], py - p.positions[2 * k + 1],
                            dx - stride(p.positions[2 * k], p.velocity[2 * k], p.seconds),
                            dy - stride(p.positions[2 * k + 1], p.velocity[2 * k + 1], p.seconds), 2.f * rho));
                p.progress[i] = progress_of(contact);
            }
            for (int a = 0; a < A; a++) advance(p, world, a);
        }
    }
}

extern "C" void place(const Placing* given) {
    const Placing& p = *given;
    const World& w = p.world;
    #pragma omp parallel for schedule(static) num_threads(w.n_threads)
    for (int agent = 0; agent < w.n_worlds * w.n_agents; agent++) {
        int world = agent / w.n_agents, a = agent % w.n_agents, design = w.design[world];
        Pose pose = pose_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
        for (int m = 0; m < w.n_model; m++) place_line(w, pose, agent, m);
        if (!p.lit) continue;
        for (int texel = w.model_texels[a * w.n_model]; texel < w.model_texels[(a + 1) * w.n_model]; texel++) {
            float x, y;
            agent_texel(w, world, a, texel, x, y);
            w.agent_light[world * (long long)w.n_agent_texels + texel] = light_at(w, design, x, y);
        }
    }
}

// One thread's working memory: the spans of a world's lines, and a screen.
struct Bench {
    std::vector<Span> spans;
    std::vector<float> inverse;
    std::vector<int> index;
    std::vector<Ray> rays;
};

static void raster_lines(const Camera& camera, const Screen& screen, const float* lengths, const float* lines, int n, int offset, int skip_first, int skip_last,
                         Bench& bench) {
    if ((int)bench.spans.size() < n) bench.spans.resize(n);
    Span* spans = bench.spans.data();
    float* inverse = bench.inverse.data();
    int* index = bench.index.data();
    #pragma omp simd
    for (int l = 0; l < n; l++) spans[l] = span_of(camera, screen, lines[4 * l], lines[4 * l + 1], lines[4 * l + 2], lines[4 * l + 3]);
    for (int l = 0; l < n; l++) {
        Span span = spans[l];
        if (span.first >= span.last || (l >= skip_first && l < skip_last)) continue;
        if (span.close) {
            for (int r = span.first; r < span.last; r++) {
                float here = inverse_depth(span, screen, r, lengths[r]);
                if (here > inverse[r]) { inverse[r] = here; index[r] = offset + l; }
            }
            continue;
        }
        #pragma omp simd
        for (int r = span.first; r < span.last; r++) {
            float here = span.base + span.gain * (float)r;
            int nearer = here > inverse[r];
            inverse[r] = nearer ? here : inverse[r];
            index[r] = nearer ? offset + l : index[r];
        }
    }
}

// Shades a view's rays, run by run of those that hit the same line.
static void shade(const Sight& p, const Screen& screen, const Scene& scene, const Camera& camera, int view, unsigned int* seen, Bench& bench, int& fresh) {
    for (int start = 0, end; start < p.res; start = end) {
        int l = bench.index[start];
        for (end = start + 1; end < p.res && bench.index[end] == l;) end++;
        if (p.indices) for (int r = start; r < end; r++) p.indices[(long long)view * p.res + r] = l;
        if (l < 0)
            for (int r = start; r < end; r++) { bench.rays[r] = {0.f, 0.f, 0.f, 0.f}; miss_ray(p, (long long)view * p.res + r); }
        else {
            Surface surface = surface_of<1>(p.world, scene, camera, l);
            for (int r = start; r < end; r++) bench.rays[r] = shade_ray<1>(p, screen, scene, surface, view, seen, r, bench.inverse[r], fresh);
        }
    }
}

extern "C" void sight(const Sight* given) {
    const Sight& p = *given;
    const World& w = p.world;
    Screen screen = screen_of(p);
    #pragma omp parallel num_threads(w.n_threads)
    {
        Bench bench;
        bench.rays.resize(p.res);
        #pragma omp for schedule(static)
        for (int agent = 0; agent < w.n_worlds * w.n_agents; agent++) {
            int world = agent / w.n_agents, a = agent % w.n_agents, fresh = 0;
            Scene scene = scene_of(w, world);
            notice(p.fault, world, p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent]);
            if (p.imu) for (int k = 0; k < 3; k++) feel(p, agent, k);
            if (p.seen && p.forget && p.forget[agent])
                for (int i = 0; i < p.n_words; i++) p.seen[agent * (long long)p.n_words + i] = 0u;
            for (int c = 0; c < p.n_cameras; c++) {
                Camera camera = camera_at(p.positions[2 * agent], p.positions[2 * agent + 1], p.angles[agent] + p.yaws[c]);
                bench.inverse.assign(p.res, 0.f);
                bench.index.assign(p.res, -1);
                if (w.n_agents > 1)
                    raster_lines(camera, screen, p.ray_lengths, scene.agent_lines, scene.n_agent_lines, 0, a * w.n_model, (a + 1) * w.n_model, bench);
                raster_lines(camera, screen, p.ray_lengths, w.walls + 4 * (long long)scene.first_wall, scene.n_walls, scene.n_agent_lines, 0, 0, bench);
                int view = agent * p.n_cameras + c;
                if (p.middle) p.middle[view] = bench.index[p.res / 2];
                unsigned int* seen = p.seen ? p.seen + agent * (long long)p.n_words : nullptr;
                shade(p, screen, scene, camera, view, seen, bench, fresh);
                for (int pixel = 0; pixel < p.n_pixels; pixel++) {
                    const Ray* rays = bench.rays.data() + pixel * p.subsample;
                    Ray sum = rays[0];
                    if (p.subsample == 4) sum = plus(plus(rays[0], rays[1]), plus(rays[2], rays[3]));
                    else for (int k = 1; k < p.subsample; k++) sum = plus(sum, rays[k]);
                    write_pixel(p, view, pixel, sum);
                }
            }
            if (p.fresh) p.fresh[agent] = fresh;
        }
    }
}

extern "C" void draw(const Draw* given) {
    const Draw& p = *given;
    #pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int lane = 0; lane < p.n_lanes; lane++) draw_lane(p, lane);
}

extern "C" void spawn(const Spawn* given) {
    const Spawn& p = *given;
    #pragma omp parallel for schedule(static) num_threads(p.world.n_threads)
    for (int world = 0; world < p.world.n_worlds; world++) spawn_world(p, world);
}
