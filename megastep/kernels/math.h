// The mathematics of the engine: plain C++ without includes, compiled for the CPU and the GPU alike, and equal on both to the last bit. Hence no
// fused multiply-add (a compiler flag on either side), IEEE division and square root, and our own sine and cosine.
// Before it stand, from the backend: HD (how a function is declared), and SQRT, CEIL, FLOOR, RINT and RECIPROCAL of a float, correctly rounded; RECIPROCAL where
// both it and its argument lie well within what a float can hold, elsewhere anything.

HD float low(float a, float b) { return a < b ? a : b; }
HD float high(float a, float b) { return a > b ? a : b; }
HD float clamp(float x, float a, float b) { return low(high(x, a), b); }
HD int lowest(int a, int b) { return a < b ? a : b; }
HD int highest(int a, int b) { return a > b ? a : b; }
HD float cross(float ax, float ay, float bx, float by) { return ax * by - ay * bx; }
HD int is_finite(float x) { return x - x == 0.f; }

// Degrees to sine and cosine. The quarter turns leave exactly in degrees; the rest, within 45 degrees, goes through Cephes' polynomials (1 ulp).
HD void sincos_degrees(float degrees, float& sine, float& cosine) {
    float quarters = RINT(degrees * (1.f / 90.f));
    float x = (degrees - 90.f * quarters) * 0.017453292519943295f, x2 = x * x;
    float s = x + x * x2 * (-1.6666654611e-1f + x2 * (8.3321608736e-3f + x2 * -1.9515295891e-4f));
    float c = 1.f - 0.5f * x2 + x2 * x2 * (4.166664568298827e-2f + x2 * (-1.388731625493765e-3f + x2 * 2.443315711809948e-5f));
    int quadrant = (int)quarters & 3;
    float swapped_s = quadrant & 1 ? c : s, swapped_c = quadrant & 1 ? s : c;
    sine = quadrant & 2 ? -swapped_s : swapped_s;
    cosine = (quadrant + 1) & 2 ? -swapped_c : swapped_c;
}

// ---- Movement: swept discs ----

constexpr float NO_CONTACT = 2.f;       // beyond the end of the step
constexpr float INFLATION = 1.001f;     // of the radius, so that a stopped agent's camera stays on its side of the wall
constexpr float SHORTENING = 0.99f;     // of the free part of a step

// How far a coordinate goes in a step: what is left after rounding, so that the way that is tried is the way that is gone.
HD float stride(float from, float velocity, float seconds) { return (from + velocity * seconds) - from; }

// Fraction of the step d after which a point at g, relative to a disc of radius rho about the origin, enters it. Inside already: 0 if it nears the middle.
HD float sweep_point(float gx, float gy, float dx, float dy, float rho) {
    float approach = -(gx * dx + gy * dy), outside = gx * gx + gy * gy - rho * rho;
    if (!(approach > 0.f)) return NO_CONTACT;
    if (outside < 0.f) return 0.f;
    float offset = cross(gx, gy, dx, dy);
    float reach = rho * rho * (dx * dx + dy * dy) - offset * offset;
    if (reach < 0.f) return NO_CONTACT;
    return outside / (approach + SQRT(reach));
}

// Do the bounding boxes of a swept disc and of a segment meet? Cheap, and rules out nearly every wall.
HD int boxes_meet(float px, float py, float dx, float dy, float ax, float ay, float bx, float by, float rho) {
    return (low(ax, bx) <= high(px, px + dx) + rho) & (high(ax, bx) >= low(px, px + dx) - rho)
         & (low(ay, by) <= high(py, py + dy) + rho) & (high(ay, by) >= low(py, py + dy) - rho);
}

// Fraction of the step d after which a disc of radius rho at p touches the segment ab, or NO_CONTACT. A disc that overlaps it already is held if it comes
// nearer and free if it leaves: the distance to a convex body along a straight path, once growing, grows for ever. Where rounding cannot tell whether the
// disc is beside the segment or beyond its end, it is taken for both.
HD float sweep_segment(float px, float py, float dx, float dy, float ax, float ay, float bx, float by, float rho) {
    if (!boxes_meet(px, py, dx, dy, ax, ay, bx, by, rho)) return NO_CONTACT;
    float ex = bx - ax, ey = by - ay, gx = px - ax, gy = py - ay, hx = px - bx, hy = py - by;
    float length2 = ex * ex + ey * ey, along = gx * ex + gy * ey, slack = 1e-6f * (length2 + high(gx * ex, -gx * ex) + high(gy * ey, -gy * ey));
    float height = cross(ex, ey, gx, gy), climb = cross(ex, ey, dx, dy);
    if (height < 0.f) { height = -height; climb = -climb; }
    float gap = height - rho * SQRT(length2), nx = along > 0.f ? hx : gx, ny = along > 0.f ? hy : gy;
    int nearing = along > -slack && along < length2 + slack && climb < 0.f, beyond = !(along > 0.f && along < length2);
    int overlaps_end = beyond && nx * nx + ny * ny < rho * rho, overlaps = overlaps_end || (!beyond && gap < 0.f);
    if ((nearing && gap < 0.f) || (overlaps_end && nx * dx + ny * dy < 0.f)) return 0.f;
    if (overlaps && !nearing) return NO_CONTACT;
    float first = low(sweep_point(gx, gy, dx, dy, rho), sweep_point(hx, hy, dx, dy, rho));
    if (gap >= 0.f && climb < 0.f) {
        float t = gap / -climb, foot = along + t * (dx * ex + dy * ey);
        if (foot >= -slack && foot <= length2 + slack) first = low(first, t);
    }
    return first;
}

HD float progress_of(float contact) { return contact <= 1.f ? clamp(SHORTENING * contact, 0.f, 1.f) : 1.f; }

HD float wrap_degrees(float angle) {
    float wrapped = angle - 360.f * FLOOR((angle + 180.f) * (1.f / 360.f));
    return wrapped >= 180.f ? wrapped - 360.f : (wrapped < -180.f ? wrapped + 360.f : wrapped);
}

// ---- Light ----

// A wall as a light at (lx, ly) sees it: its way, its start from there, turned round so that `area`, that of the two, is not negative; 0 if they are in line.
struct Blind { float vx, vy, wx, wy, area; };

HD Blind blind_of(float lx, float ly, float ax, float ay, float bx, float by) {
    float vx = bx - ax, vy = by - ay, wx = ax - lx, wy = ay - ly, area = cross(wx, wy, vx, vy), sign = area < 0.f ? -1.f : 1.f;
    Blind blind = {sign * vx, sign * vy, sign * wx, sign * wy, sign * area};
    return blind;
}

// Does the segment from the light along d, short of its last thousandth, meet the wall? Without a division: all sides times the determinant.
HD int blocks(const Blind& blind, float dx, float dy) {
    float den = cross(dx, dy, blind.vx, blind.vy), u = cross(blind.wx, blind.wy, dx, dy);
    return (blind.area > 0.f) & (blind.area < 0.999f * den) & (u >= 0.f) & (u <= den);
}

HD float glow(float intensity, float dx, float dy) { return 2.f * intensity / high(dx * dx + dy * dy, 1.f); }
constexpr float AMBIENT = 0.1f;

// ---- Sight: a wall covers an interval of pixels, and along it inverse depth is affine in the pixel's index ----

struct Camera { float x, y, sine, cosine; };

HD Camera camera_at(float x, float y, float degrees) {
    Camera camera = {x, y, 0.f, 1.f};
    sincos_degrees(degrees, camera.sine, camera.cosine);
    return camera;
}

// A screen as Sight gives it.
struct Screen { float edge, pitch, centre, scale, near, radius; int res; };

HD Screen screen_of(const Sight& p) {
    Screen screen = {p.edge, p.pitch, p.centre, p.scale, p.near, p.world.radius, p.res};
    return screen;
}

HD float slope(const Screen& screen, int r) { return screen.edge - screen.pitch * (float)r; }

// A line in the camera's frame: where it starts, and the way it goes.
struct Line { float ax, ay, vx, vy; };

struct Span { int first, last; float base, gain; int close; };   // pixels [first, last), 1/depth = base + gain r, does it come within the radius

HD void to_camera(const Camera& camera, float x, float y, float& depth, float& left) {
    float dx = x - camera.x, dy = y - camera.y;
    depth = camera.cosine * dx + camera.sine * dy;
    left = camera.cosine * dy - camera.sine * dx;
}

HD Line line_in(const Camera& camera, float ax, float ay, float bx, float by) {
    Line line; float cx, cy;
    to_camera(camera, ax, ay, line.ax, line.ay);
    to_camera(camera, bx, by, cx, cy);
    line.vx = cx - line.ax; line.vy = cy - line.ay;
    return line;
}

// The pixels a wall covers. Walls that share a corner compute it from the same bits, and intervals are half open: no ray slips between them, none sees both.
// What lies nearer than `near` in depth is within the radius for every ray of the screen, so cutting it off loses nothing.
HD Span span_of(const Camera& camera, const Screen& screen, float wax, float way, float wbx, float wby) {
    float ax, ay, bx, by;
    to_camera(camera, wax, way, ax, ay);
    to_camera(camera, wbx, wby, bx, by);
    float vx = bx - ax, vy = by - ay, area = cross(ax, ay, vx, vy);
    int behind_a = ax < screen.near, behind_b = bx < screen.near;
    float cut = ay + (screen.near - ax) * RECIPROCAL(vx) * vy;      // where the wall crosses the near plane, if it does
    float pa = screen.centre - screen.scale * ((behind_a ? cut : ay) * RECIPROCAL(behind_a ? screen.near : ax));
    float pb = screen.centre - screen.scale * ((behind_b ? cut : by) * RECIPROCAL(behind_b ? screen.near : bx));
    float res = (float)screen.res;
    Span span;
    span.first = (int)CEIL(clamp(low(pa, pb), 0.f, res));
    span.last = (behind_a & behind_b) | (area == 0.f) ? 0 : (int)CEIL(clamp(high(pa, pb), 0.f, res));
    float k = RECIPROCAL(area);
    span.base = (vy - screen.edge * vx) * k;
    span.gain = screen.pitch * vx * k;
    span.close = area * area <= screen.radius * screen.radius * (vx * vx + vy * vy) * 1.001f;
    return span;
}

// What a box may cover: pixels [first, last], inverse depths up to `most`; its squared distance from the camera, or -1 if nothing in it can cover a pixel: all of it
// lies behind, or beyond one edge of the screen. The slack is more than rounding can make of 200 m.
struct Cover { float distance, most; int first, last; };

HD Cover cover_of(const Camera& camera, const Screen& screen, float half_width, float lx, float ly, float hx, float hy) {
    float slack = 1e-3f * (1.f + half_width), nearest = 1e9f, low_pixel = 1e9f, high_pixel = -1e9f;
    int ahead = 0, rightwards = 0, leftwards = 0;
    for (int corner = 0; corner < 4; corner++) {
        float x, y;
        to_camera(camera, corner & 1 ? hx : lx, corner & 2 ? hy : ly, x, y);
        ahead |= x >= -1e-3f;
        leftwards |= y - half_width * x <= slack;
        rightwards |= y + half_width * x >= -slack;
        nearest = low(nearest, x);
        float pixel = screen.centre - screen.scale * (y * RECIPROCAL(x));
        low_pixel = low(low_pixel, pixel); high_pixel = high(high_pixel, pixel);
    }
    float dx = high(high(lx - camera.x, camera.x - hx), 0.f), dy = high(high(ly - camera.y, camera.y - hy), 0.f);
    Cover cover = {dx * dx + dy * dy, 1e9f, 0, screen.res - 1};
    if (!(ahead & leftwards & rightwards)) cover.distance = -1.f;
    if (nearest > 0.01f) {                                       // wholly ahead: then its corners bound what it covers
        float last = (float)(screen.res - 1);
        cover.most = 1.01f * RECIPROCAL(nearest - 1e-3f);
        cover.first = (int)clamp(low_pixel - 1.f, 0.f, last);
        cover.last = (int)clamp(high_pixel + 2.f, 0.f, last);
    }
    return cover;
}

// Inverse depth of a span at pixel r, whose ray is `length` long at unit depth; 0, which sees nothing, where that is within the agent's radius.
HD float inverse_depth(const Span& span, const Screen& screen, int r, float length) {
    float inverse = span.base + span.gain * (float)r;
    return span.close && inverse * screen.radius >= length ? 0.f : inverse;
}

struct Hit { float location, facing; };   // fraction along the line; squared sine between ray and line

// One division serves both.
HD Hit hit_of(const Line& line, float y, float length) {
    float across = line.vy - y * line.vx, size = length * length * (line.vx * line.vx + line.vy * line.vy);
    float inverse = RECIPROCAL(across * size);
    Hit hit;
    hit.location = clamp((y * line.ax - line.ay) * size * inverse, 0.f, 1.f);
    hit.facing = across * across * (across * inverse);
    return hit;
}

HD float cosine_of(const Line& line, float y, float length) {
    return (line.vx + y * line.vy) / (length * SQRT(line.vx * line.vx + line.vy * line.vy) + 1e-6f);
}

HD float depth_reading(float distance, float radius, float per_depth) { return 1.f - clamp((distance - radius) * per_depth, 0.f, 1.f); }

// Linear filtering between texel centres, clamped at the line's ends. A location is within [0, 1].
struct Filter { int left, right; float weight; };

HD Filter filter_at(float location, int width) {
    float at = location * (float)width - 0.5f, floor = FLOOR(at);
    Filter filter = {highest((int)floor, 0), lowest((int)floor + 1, width - 1), at - floor};
    return filter;
}

HD int texel_at(float location, int width) { return lowest((int)(location * (float)width), width - 1); }

HD float mix(float a, float b, float weight) { return a + weight * (b - a); }

// ---- Random numbers: Philox 4x32-10 (Salmon et al. 2011). Key = seed, counter = (lane, draw) ----

struct Four { unsigned int a, b, c, d; };

HD Four philox(unsigned int lane, unsigned int draw, unsigned int key0, unsigned int key1) {
    Four x = {lane, draw, 0u, 0u};
    for (int round = 0; round < 10; round++) {
        unsigned long long p = 0xD2511F53ull * x.a, q = 0xCD9E8D57ull * x.c;
        Four next = {(unsigned int)(q >> 32) ^ x.b ^ key0, (unsigned int)q, (unsigned int)(p >> 32) ^ x.d ^ key1, (unsigned int)p};
        x = next;
        key0 += 0x9E3779B9u; key1 += 0xBB67AE85u;
    }
    return x;
}

HD float uniform(unsigned int bits) { return (float)(bits >> 8) * (1.f / 16777216.f); }
