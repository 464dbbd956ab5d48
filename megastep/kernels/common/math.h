// Arithmetic on scalars, angles and poses.
#pragma once
#include "common/backend.h"

// Not the compilers' min and max, which treat NaN and -0 differently on CPU and GPU.
HD float minf(float a, float b) { return a < b ? a : b; }

HD float maxf(float a, float b) { return a > b ? a : b; }

HD int mini(int a, int b) { return a < b ? a : b; }

HD int maxi(int a, int b) { return a > b ? a : b; }

HD int within(int i, int max) { return mini(maxi(i, 0), max); }

HD float clamp(float x, float min, float max) { return minf(maxf(x, min), max); }

HD float mix(float a, float b, float weight) { return a + weight * (b - a); }

HD float cross(float ax, float ay, float bx, float by) { return ax * by - ay * bx; }

HD int is_finite(float x) { return x - x == 0.f; }

struct Range {
    int first, end;  // exclusive
};

// Where those of owner i begin and end, of n in all.
HD Range range_of(const int* starts, int i, int n) {
    return {within(starts[i], n), within(starts[i + 1], n)};
}

// Four floats, read and written in one instruction.
struct ALIGNED Float4 {
    float x, y, z, w;
};

// Quarter turns are subtracted exactly, in degrees. The remaining angle, within 45 degrees, goes
// through the polynomials of Cephes (error: 1 ulp).
HD void sincos_degrees(float degrees, float& sine, float& cosine) {
    float quarters = RINT(degrees * (1.f / 90.f));
    float x = (degrees - 90.f * quarters) * 0.017453292519943295f;
    float x2 = x * x;
    float s = -1.6666654611e-1f + x2 * (8.3321608736e-3f + x2 * -1.9515295891e-4f);
    float c = 4.166664568298827e-2f + x2 * (-1.388731625493765e-3f + x2 * 2.443315711809948e-5f);
    s = x + x * x2 * s;
    c = 1.f - 0.5f * x2 + x2 * x2 * c;
    int quadrant = TO_INT(quarters) & 3;
    float turned_s = quadrant & 1 ? c : s;
    float turned_c = quadrant & 1 ? s : c;
    sine = quadrant & 2 ? -turned_s : turned_s;
    cosine = (quadrant + 1) & 2 ? -turned_c : turned_c;
}

// The same angle in [-180, 180).
HD float wrap_degrees(float angle) {
    float wrapped = angle - 360.f * FLOOR((angle + 180.f) * (1.f / 360.f));
    if (wrapped >= 180.f)
        return wrapped - 360.f;
    return wrapped < -180.f ? wrapped + 360.f : wrapped;
}

struct Pose {
    float x, y, sine, cosine;
};

HD Pose pose_at(float x, float y, float degrees) {
    Pose pose = {x, y, 0.f, 1.f};
    sincos_degrees(degrees, pose.sine, pose.cosine);
    return pose;
}
