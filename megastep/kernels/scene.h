// What the operations share beyond single points and lines: one agent's move, its model's place, one pixel's colour. Both backends compile it.
// Before it stand HD, NAN_VALUE, INFINITE, LOAD(at), which reads what no one writes meanwhile, HALF_BITS(x), the bits of x in half precision rounded to nearest even, and OR_BITS(word, bits), which sets bits of a word of `seen` and returns what was there.

HD void notice(int* fault, int world, float x, float y, float angle) {
    if (!is_finite(x) || !is_finite(y) || !is_finite(angle)) *fault = world + 1;
}

// An agent takes its action: velocities decay, and the action's are added, turned into the world's frame.
HD void steer(const Motion& p, int world, int a) {
    int i = world * p.world.n_agents + a;
    long long action = p.actions[i];
    if (action < 0 || action >= p.n_moves) { *p.fault = -(world + 1); action = 0; }
    const float* move = p.moves + 3 * action;
    float s, c;
    sincos_degrees(p.angles[i], s, c);
    float* velocity = p.velocity + 2 * i;
    velocity[0] = p.keep * velocity[0] + (c * move[0] - s * move[1]);
    velocity[1] = p.keep * velocity[1] + (s * move[0] + c * move[1]);
    p.angvelocity[i] = p.keep * p.angvelocity[i] + move[2];
}

HD void advance(const Motion& p, int world, int a) {
    int i = world * p.world.n_agents + a;
    float progress = p.progress[i];
    float* position = p.positions + 2 * i; float* velocity = p.velocity + 2 * i;
    position[0] += progress * stride(position[0], velocity[0], p.seconds);
    position[1] += progress * stride(position[1], velocity[1], p.seconds);
    p.angles[i] = wrap_degrees(p.angles[i] + progress * (p.angvelocity[i] * p.seconds));
    notice(p.fault, world, position[0], position[1], p.angles[i]);
    if (progress < 1.f) { velocity[0] = 0.f; velocity[1] = 0.f; p.angvelocity[i] = 0.f; }
}

// Number k of an agent's three of inertia.
HD void feel(const Sight& p, int agent, int k) {
    float s, c, x = p.velocity[2 * agent], y = p.velocity[2 * agent + 1], turn = p.angvelocity[agent];
    sincos_degrees(p.angles[agent], s, c);
    float ahead = c * x + s * y, left = c * y - s * x;
    p.imu[3 * (long long)agent + k] = HALF_BITS(k == 0 ? turn * (1.f / 360.f) : (k == 1 ? ahead : left) * (1.f / 10.f));
}

struct Pose { float x, y, sine, cosine; };

HD Pose pose_at(float x, float y, float degrees) {
    Pose pose = {x, y, 0.f, 1.f};
    sincos_degrees(degrees, pose.sine, pose.cosine);
    return pose;
}

// Sums alone: a sum and a difference side by side are fused by GCC 12 as it vectorises, whatever -ffp-contract says.
HD void place_line(const World& w, const Pose& pose, int agent, int m) {
    float minus_sine = -pose.sine;
    float* line = w.agent_lines + 4 * (agent * (long long)w.n_model + m);
    for (int end = 0; end < 2; end++) {
        float x = w.model[4 * m + 2 * end], y = w.model[4 * m + 2 * end + 1];
        line[2 * end] = pose.x + (pose.cosine * x + minus_sine * y);
        line[2 * end + 1] = pose.y + (pose.sine * x + pose.cosine * y);
    }
}

// Where an agent's texel lies, once its lines are placed.
HD void agent_texel(const World& w, int world, int a, int texel, float& x, float& y) {
    int l = a * w.n_model;
    while (texel >= w.model_texels[l + 1]) l++;
    int first = w.model_texels[l], width = w.model_texels[l + 1] - first;
    float u = ((float)(texel - first) + 0.5f) / (float)width;
    const float* line = w.agent_lines + 4 * (world * (long long)(w.n_agents * w.n_model) + l);
    x = mix(line[0], line[2], u); y = mix(line[1], line[3], u);
}

// Could the wall hide a light from some part of a disc about an agent? Never says no wrongly: a wall is passed over only if it lies wholly on one
// side of the light's path to the middle, by more than the disc, or wholly behind the light or behind the disc.
struct Corridor { float x, y, dx, dy, along, aside; };     // from a light by (dx, dy) to a disc: how far along and aside to look, times its length

HD Corridor corridor_of(float lx, float ly, const Pose& pose, float reach) {
    float dx = pose.x - lx, dy = pose.y - ly, length2 = dx * dx + dy * dy, longest = high(dx, -dx), other = high(dy, -dy);
    float aside = reach * (high(longest, other) + 0.5f * low(longest, other)) + 1e-3f;        // at least the length, at most an eighth more
    Corridor corridor = {lx, ly, dx, dy, length2 + aside, aside};
    return corridor;
}

HD int may_block(const Corridor& c, float ax, float ay, float bx, float by) {
    float sa = cross(c.dx, c.dy, ax - c.x, ay - c.y), sb = cross(c.dx, c.dy, bx - c.x, by - c.y);
    float ta = c.dx * (ax - c.x) + c.dy * (ay - c.y), tb = c.dx * (bx - c.x) + c.dy * (by - c.y);
    return !((low(sa, sb) > c.aside) | (high(sa, sb) < -c.aside) | (high(ta, tb) < -c.aside) | (low(ta, tb) > c.along));
}

// The same for all walls in a box.
HD int may_block_box(const Corridor& c, float x0, float y0, float x1, float y1) {
    float least = 1e9f, most = -1e9f, nearest = 1e9f, furthest = -1e9f;
    for (int corner = 0; corner < 4; corner++) {
        float x = (corner & 1 ? x1 : x0) - c.x, y = (corner & 2 ? y1 : y0) - c.y;
        float side = cross(c.dx, c.dy, x, y), along = c.dx * x + c.dy * y;
        least = low(least, side); most = high(most, side); nearest = low(nearest, along); furthest = high(furthest, along);
    }
    return !((least > c.aside) | (most < -c.aside) | (furthest < -c.aside) | (nearest > c.along));
}

// One world's lines and texels.
struct Scene {
    const float* agent_lines; const float* agent_textures; const float* agent_light;
    int first_wall, n_walls, n_agent_lines, first_texel;
};

HD Scene scene_of(const World& w, int world) {
    int design = w.design[world], first = w.wall_starts[design], n = w.n_agents * w.n_model;
    Scene scene = {w.agent_lines + 4 * (world * (long long)n), w.agent_textures + 3 * (design * (long long)w.n_agent_texels),
                   w.agent_light + world * (long long)w.n_agent_texels, first, w.wall_starts[design + 1] - first, n, w.texel_starts[first]};
    return scene;
}

// Sixteen bytes that move as one.
struct ALIGNED Four_floats { float x, y, z, w; };

struct Colour { float red, green, blue; };

HD Colour lit(const Four_floats l, const Four_floats r, float weight, float facing) {
    float light = mix(l.w, r.w, weight) * facing;
    Colour colour = {mix(l.x, r.x, weight) * light, mix(l.y, r.y, weight) * light, mix(l.z, r.z, weight) * light};
    return colour;
}

HD Colour wall_colour(const World& w, int first, int width, const Hit& hit) {
    Filter f = filter_at(hit.location, width);
    const Four_floats* texels = (const Four_floats*)w.texels;
    return lit(LOAD(texels + (first + f.left)), LOAD(texels + (first + f.right)), f.weight, hit.facing);
}

HD Four_floats agent_texel_colour(const Scene& scene, int texel) {
    const float* colour = scene.agent_textures + 3 * texel;
    Four_floats made = {colour[0], colour[1], colour[2], scene.agent_light[texel]};
    return made;
}

HD Colour agent_colour(const Scene& scene, int first, int width, const Hit& hit) {
    Filter f = filter_at(hit.location, width);
    return lit(agent_texel_colour(scene, first + f.left), agent_texel_colour(scene, first + f.right), f.weight, hit.facing);
}

// Marks a texel as seen; 1 if it was not before. Most have been, so a plain look comes first.
HD int mark(unsigned int* seen, int texel) {
    unsigned int bit = 1u << (texel & 31);
    return !(seen[texel >> 5] & bit) && !(OR_BITS(seen + (texel >> 5), bit) & bit);
}

HD void miss_ray(const Sight& p, long long ray) {
    if (p.locations) p.locations[ray] = NAN_VALUE;
    if (p.dots) p.dots[ray] = NAN_VALUE;
    if (p.distances) p.distances[ray] = INFINITE;
    if (p.screen) { float* out = p.screen + 3 * ray; out[0] = 0.f; out[1] = 0.f; out[2] = 0.f; }
}

// A line that rays hit: how it lies before the camera, and its texels. `crowd`: it may be an agent's.
struct Surface { Line line; int first, width, of_agent; };

template <int crowd>
HD Surface surface_of(const World& w, const Scene& scene, const Camera& camera, int l) {
    int of_agent = crowd && l < scene.n_agent_lines, i = of_agent ? l : l + (scene.first_wall - scene.n_agent_lines);
    Four_floats ends = LOAD((const Four_floats*)(of_agent ? scene.agent_lines : w.walls) + i);
    const int* starts = (of_agent ? w.model_texels : w.texel_starts) + i;
    Surface surface = {line_in(camera, ends.x, ends.y, ends.z, ends.w), starts[0], starts[1] - starts[0], of_agent};
    return surface;
}

// One ray that hits a surface: fills what is asked for at full resolution, if `whole`, and returns its share of its pixel. Counts in `fresh` a texel seen for the first time.
struct Ray { float red, green, blue, depth; };

template <int whole>
HD Ray shade_ray(const Sight& p, const Screen& screen, const Scene& scene, const Surface& surface, int view, unsigned int* seen, int r, float inverse, int& fresh) {
    float y = slope(screen, r), length = p.ray_lengths[r], distance = length * RECIPROCAL(inverse);
    Hit hit = hit_of(surface.line, y, length);
    Ray out = {0.f, 0.f, 0.f, depth_reading(distance, screen.radius, p.per_depth)};
    if (p.rgb || (whole && p.screen)) {
        Colour colour = surface.of_agent ? agent_colour(scene, surface.first, surface.width, hit) : wall_colour(p.world, surface.first, surface.width, hit);
        out.red = colour.red; out.green = colour.green; out.blue = colour.blue;
    }
    if (seen && !surface.of_agent) fresh += mark(seen, surface.first - scene.first_texel + texel_at(hit.location, surface.width));
    if (!whole) return out;
    long long ray = (long long)view * p.res + r;
    if (p.screen) { float* rgb = p.screen + 3 * ray; rgb[0] = out.red; rgb[1] = out.green; rgb[2] = out.blue; }
    if (p.locations) p.locations[ray] = hit.location;
    if (p.dots) p.dots[ray] = cosine_of(surface.line, y, length);
    if (p.distances) p.distances[ray] = distance;
    return out;
}

HD Ray plus(const Ray& a, const Ray& b) {
    Ray sum = {a.red + b.red, a.green + b.green, a.blue + b.blue, a.depth + b.depth};
    return sum;
}

// A pixel is the mean of its rays, which are summed in order; four of them, the usual number, by pairs.
HD void write_pixel(const Sight& p, int view, int pixel, const Ray& sum) {
    int n_pixels = p.n_pixels;
    float share = p.share;
    if (p.rgb) {
        unsigned short* rgb = p.rgb + (long long)view * (3 * n_pixels) + pixel;
        rgb[0] = HALF_BITS(sum.red * share); rgb[n_pixels] = HALF_BITS(sum.green * share); rgb[2 * n_pixels] = HALF_BITS(sum.blue * share);
    }
    if (p.depth) p.depth[(long long)view * n_pixels + pixel] = HALF_BITS(sum.depth * share);
}

// Respawns a world's agents: each at a point of its own share of the design's points, at rest, looking anywhere.
HD void spawn_world(const Spawn& p, int world) {
    int A = p.world.n_agents, all = 1;
    for (int a = 0; a < A; a++) all &= p.mask[world * A + a] != 0;
    for (int a = 0; a < A; a++) {
        int i = world * A + a, share = p.n_points / A;
        if (!p.mask[i]) continue;
        Four bits = philox((unsigned int)i, (unsigned int)p.counts[i]++, p.seed_low, p.seed_high);
        if (a == 0 && all && p.n_designs) p.world.design[world] = (int)(uniform(bits.c) * (float)p.n_designs);
        int point = a * share + (int)(uniform(bits.a) * (float)share);
        const float* at = p.points + 2 * ((long long)p.world.design[world] * p.n_points + point);
        p.positions[2 * i] = at[0]; p.positions[2 * i + 1] = at[1];
        p.angles[i] = 360.f * uniform(bits.b) - 180.f;
        p.velocity[2 * i] = 0.f; p.velocity[2 * i + 1] = 0.f; p.angvelocity[i] = 0.f;
    }
}

HD void draw_lane(const Draw& p, int lane) {
    if (!p.mask[lane]) return;
    Four bits = philox((unsigned int)lane, (unsigned int)p.counts[lane], p.seed_low, p.seed_high);
    float* out = p.out + 4 * (long long)lane;
    out[0] = uniform(bits.a); out[1] = uniform(bits.b); out[2] = uniform(bits.c); out[3] = uniform(bits.d);
}
