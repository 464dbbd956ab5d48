// Rasterising in one dimension. A line covers an interval of pixels, and along it inverse depth is
// an affine function of the pixel's index. In a camera's frame x is depth and y points left.
#pragma once
#include "params.h"

constexpr int MAX_RES = 1024;          // rays per camera: 32 tiles of 32 pixels
constexpr int MAX_SUBSAMPLE = 32;      // rays per pixel: at most one warp
constexpr int NEAREST_LINE_BYTES = 8;  // of shared memory per ray, while rendering

// The nearest line at a pixel. On the GPU each warp keeps one per pixel in dynamic shared memory.
struct alignas(8) NearestLine {
    float inverse;  // inverse depth, per metre
    int line;       // -1: none
};
static_assert(sizeof(NearestLine) == NEAREST_LINE_BYTES, "Python allocates shared memory for them");

// The fields of RenderParams with these names.
struct Screen {
    float edge, pitch, centre, scale, near, radius;
    int res;
};

HD Screen screen_of(const RenderParams& p) {
    return {p.edge, p.pitch, p.centre, p.scale, p.near, p.scenery.radius, p.res};
}

HD float ray_slope(const Screen& screen, int r) { return screen.edge - screen.pitch * (float)r; }

HD void to_camera(const Pose& camera, float x, float y, float& depth, float& left) {
    float dx = x - camera.x, dy = y - camera.y;
    depth = camera.cosine * dx + camera.sine * dy;
    left = camera.cosine * dy - camera.sine * dx;
}

// Pixels [first, end); at pixel r inverse depth is base + gain r. 16 bytes, moved in one
// instruction.
struct ALIGNED PixelSpan {
    int first, end;
    float base, gain;
};

// `near_clipped`: parts of the line may be within the agent's radius, and these are invisible.
struct Projection {
    PixelSpan span;
    int near_clipped;
};

// Projects the line from (x0, y0) to (x1, y1) onto the screen. Lines that share a corner compute
// its pixel from the same bits, and intervals are half open, so every ray near a corner hits
// exactly one of them. The part closer than `near` in depth is cut off: for every ray it is within
// the radius, hence invisible. The ends are four floats because GCC 12 does not vectorise a loop
// that builds structs.
HD Projection project(const Pose& camera, const Screen& screen, float x0, float y0, float x1,
                      float y1) {
    float ax, ay, bx, by;
    to_camera(camera, x0, y0, ax, ay);
    to_camera(camera, x1, y1, bx, by);
    float vx = bx - ax, vy = by - ay;
    float area = cross(ax, ay, vx, vy);
    int behind_a = ax < screen.near, behind_b = bx < screen.near;
    float cut =
        ay + (screen.near - ax) * RECIPROCAL(vx) * vy;  // y where the line crosses the near plane
    float slope_a = (behind_a ? cut : ay) * RECIPROCAL(behind_a ? screen.near : ax);
    float slope_b = (behind_b ? cut : by) * RECIPROCAL(behind_b ? screen.near : bx);
    float pixel_a = screen.centre - screen.scale * slope_a;
    float pixel_b = screen.centre - screen.scale * slope_b;
    float res = (float)screen.res;
    int hidden = (behind_a & behind_b) | (area == 0.f);
    float k = RECIPROCAL(area);
    Projection projection;
    projection.span.first = (int)CEIL(clamp(minf(pixel_a, pixel_b), 0.f, res));
    projection.span.end = hidden ? 0 : (int)CEIL(clamp(maxf(pixel_a, pixel_b), 0.f, res));
    projection.span.base = (vy - screen.edge * vx) * k;
    projection.span.gain = screen.pitch * vx * k;
    float reach2 = screen.radius * screen.radius * (vx * vx + vy * vy);
    projection.near_clipped = area * area <= reach2 * 1.001f;
    return projection;
}

// Bounds on what the walls of a box cover: pixels [first, last], inverse depths up to max_inverse.
// distance2 is the box's squared distance from the camera, or -1 if it covers no pixel.
struct ScreenBounds {
    float distance2, max_inverse;
    int first, last;
};

// A box covers no pixel if it lies entirely behind the camera or beyond one edge of the screen. The
// slack exceeds the rounding error at 200 m.
HD ScreenBounds bounds_of(const Pose& camera, const Screen& screen, float half_width, float min_x,
                          float min_y, float max_x, float max_y) {
    float slack = 1e-3f * (1.f + half_width);
    float min_depth = 1e9f, min_pixel = 1e9f, max_pixel = -1e9f;
    int ahead = 0, rightwards = 0, leftwards = 0;
    for (int corner = 0; corner < 4; corner++) {
        float x, y;
        to_camera(camera, corner & 1 ? max_x : min_x, corner & 2 ? max_y : min_y, x, y);
        ahead |= x >= -1e-3f;
        leftwards |= y - half_width * x <= slack;
        rightwards |= y + half_width * x >= -slack;
        min_depth = minf(min_depth, x);
        float pixel = screen.centre - screen.scale * (y * RECIPROCAL(x));
        min_pixel = minf(min_pixel, pixel);
        max_pixel = maxf(max_pixel, pixel);
    }
    float dx = maxf(maxf(min_x - camera.x, camera.x - max_x), 0.f);
    float dy = maxf(maxf(min_y - camera.y, camera.y - max_y), 0.f);
    ScreenBounds bounds = {dx * dx + dy * dy, 1e9f, 0, screen.res - 1};
    if (!(ahead & leftwards & rightwards))
        bounds.distance2 = -1.f;
    if (min_depth > 0.01f) {  // entirely ahead: its corners bound the pixels it covers
        float last = (float)(screen.res - 1);
        bounds.max_inverse = 1.01f * RECIPROCAL(min_depth - 1e-3f);
        bounds.first = (int)clamp(min_pixel - 1.f, 0.f, last);
        bounds.last = (int)clamp(max_pixel + 2.f, 0.f, last);
    }
    return bounds;
}

// Bounds on what a disc covers. distance2 is 0, or -1 if it covers no pixel.
HD ScreenBounds bounds_of_disc(const Pose& camera, const Screen& screen, float half_width, float x,
                               float y, float radius) {
    float depth, left;
    to_camera(camera, x, y, depth, left);
    float reach = radius * (1.f + half_width) + 1e-3f * (1.f + half_width);
    float least_depth = depth - radius, most_depth = depth + radius;
    int is_beside = left - half_width * depth > reach || left + half_width * depth < -reach;
    ScreenBounds bounds = {0.f, 1e9f, 0, screen.res - 1};
    if (is_beside || most_depth < -1e-3f)
        bounds.distance2 = -1.f;
    if (least_depth > 0.01f) {
        float right = left - radius, last = (float)(screen.res - 1);
        left += radius;
        float nearest = RECIPROCAL(least_depth - 1e-3f), farthest = RECIPROCAL(most_depth);
        float left_slope = left * (left > 0.f ? nearest : farthest);
        float right_slope = right * (right > 0.f ? farthest : nearest);
        bounds.max_inverse = 1.01f * nearest;
        bounds.first = (int)clamp(screen.centre - screen.scale * left_slope - 1.f, 0.f, last);
        bounds.last = (int)clamp(screen.centre - screen.scale * right_slope + 2.f, 0.f, last);
    }
    return bounds;
}
