// Discs and rectangles that touch. A wall is a rectangle without width.
#pragma once
#include "params.h"

// A disc of radius `hx` if `hy` is below 0, else a rectangle with half its sides' lengths.
struct Hull {
    float x, y, sine, cosine, hx, hy;
};

HD int is_disc(const Hull& hull) { return hull.hy < 0.f; }

// The radius of the smallest disc around a hull's centre that holds it.
HD float extent_of(float hx, float hy) { return hy < 0.f ? hx : SQRT(hx * hx + hy * hy); }

HD Hull hull_at(float x, float y, float degrees, float hx, float hy) {
    Hull hull = {x, y, 0.f, 1.f, hx, hy};
    sincos_degrees(degrees, hull.sine, hull.cosine);
    return hull;
}

HD Hull hull_of(const Float4& wall) {
    float dx = wall.z - wall.x, dy = wall.w - wall.y, length = SQRT(dx * dx + dy * dy);
    float inverse = length > 0.f ? 1.f / length : 0.f;
    float x = 0.5f * (wall.x + wall.z), y = 0.5f * (wall.y + wall.w);
    return {x, y, dy * inverse, dx * inverse, 0.5f * length, 0.f};
}

// Half the width of object k, of a size; -1 of a disc. A crate's first line is its lower side.
HD float half_width_of(const ObjectsParams& o, int k, float size) {
    if (o.shapes[k] == DISC)
        return -1.f;
    return o.shapes[k] == DOOR ? 0.f : -size * first_y_of(o, k);
}

// Where hulls a and b come within reach of each other: at up to two points along one normal, from a
// to b. `gaps` are below 0 where they overlap. `arms_a` and `arms_b` are the cross products of the
// points, relative to each centre, with the normal.
struct Touch {
    float nx, ny, gaps[2], arms_a[2], arms_b[2];
    int n;  // points
};

HD Touch swapped(const Touch& t) {
    return {-t.nx,
            -t.ny,
            {t.gaps[0], t.gaps[1]},
            {-t.arms_b[0], -t.arms_b[1]},
            {-t.arms_a[0], -t.arms_a[1]},
            t.n};
}

// One point at a gap, with an arm of the first hull; the normal goes through the second's centre.
HD Touch touch_at(float nx, float ny, float gap, float arm) {
    return {nx, ny, {gap, 0.f}, {arm, 0.f}, {0.f, 0.f}, 1};
}

HD Touch touch_discs(const Hull& a, const Hull& b) {
    float dx = b.x - a.x, dy = b.y - a.y, apart = SQRT(dx * dx + dy * dy);
    float nx = apart > 0.f ? dx / apart : 1.f, ny = apart > 0.f ? dy / apart : 0.f;
    return touch_at(nx, ny, apart - a.hx - b.hx, 0.f);
}

HD float signed_as(float x, float sign) { return sign < 0.f ? -x : x; }

// A rectangle and a disc, which it touches at its point closest to the disc's centre.
HD Touch touch_disc(const Hull& box, const Hull& disc) {
    float dx = disc.x - box.x, dy = disc.y - box.y;
    float x = box.cosine * dx + box.sine * dy, y = box.cosine * dy - box.sine * dx;
    float on_x = clamp(x, -box.hx, box.hx), on_y = clamp(y, -box.hy, box.hy);
    float nx = x - on_x, ny = y - on_y, apart = SQRT(nx * nx + ny * ny);
    if (apart > 0.f) {
        nx = nx / apart;
        ny = ny / apart;
    } else {  // the centre is inside: out through the closest side
        float in_x = box.hx - ABS(x), in_y = box.hy - ABS(y);
        int is_x = in_x < in_y;
        nx = is_x ? signed_as(1.f, x) : 0.f;
        ny = is_x ? 0.f : signed_as(1.f, y);
        apart = is_x ? -in_x : -in_y;
    }
    return touch_at(box.cosine * nx - box.sine * ny, box.sine * nx + box.cosine * ny,
                    apart - disc.hx, on_x * ny - on_y * nx);
}

// Two rectangles. Of the four directions of their sides, the one along which they are furthest
// apart is the normal; the side that it belongs to cuts the other's side that faces it.
HD Touch touch_boxes(const Hull& a, const Hull& b) {
    float dx = b.x - a.x, dy = b.y - a.y;
    float cosine = a.cosine * b.cosine + a.sine * b.sine;  // of b relative to a
    float sine = a.cosine * b.sine - a.sine * b.cosine;
    float c = ABS(cosine), s = ABS(sine);
    float ax = a.cosine * dx + a.sine * dy, ay = a.cosine * dy - a.sine * dx;  // b's centre to a
    float bx = b.cosine * dx + b.sine * dy, by = b.cosine * dy - b.sine * dx;
    float gap_ax = ABS(ax) - a.hx - (b.hx * c + b.hy * s);
    float gap_ay = ABS(ay) - a.hy - (b.hx * s + b.hy * c);
    float gap_bx = ABS(bx) - b.hx - (a.hx * c + a.hy * s);
    float gap_by = ABS(by) - b.hy - (a.hx * s + a.hy * c);
    float gap_a = maxf(gap_ax, gap_ay), gap_b = maxf(gap_bx, gap_by);
    int is_a = gap_a >= gap_b, is_x = is_a ? gap_ax >= gap_ay : gap_bx >= gap_by;
    // In the frame of the side's owner, turned by a quarter if the side is its y: the side lies at
    // `height` along the normal and reaches to both sides by `half`. The other's centre is at
    // (along, above), with its axes turned by (cosine, sine).
    const Hull& own = is_a ? a : b;
    const Hull& other = is_a ? b : a;
    float rel_x = is_a ? ax : -bx, rel_y = is_a ? ay : -by;
    sine = is_a ? sine : -sine;
    float above = is_x ? rel_x : rel_y, along = is_x ? rel_y : rel_x;
    float height = is_x ? own.hx : own.hy, half = is_x ? own.hy : own.hx;
    float up = signed_as(1.f, above);
    float x_above = is_x ? cosine : sine, x_along = is_x ? sine : cosine;    // the other's x axis
    float y_above = is_x ? -sine : cosine, y_along = is_x ? cosine : -sine;  // the other's y axis
    int faces_x = ABS(x_above) > ABS(y_above);
    float down = -up * signed_as(faces_x ? other.hx : other.hy, faces_x ? x_above : y_above);
    float mid_above = above + down * (faces_x ? x_above : y_above);
    float mid_along = along + down * (faces_x ? x_along : y_along);
    float reach = faces_x ? other.hy : other.hx;
    float end_above = reach * (faces_x ? y_above : x_above);
    float end_along = reach * (faces_x ? y_along : x_along);
    float low = -1.f, high = 1.f;  // the part of the other's side that lies over the own
    if (end_along != 0.f) {
        float first = (-half - mid_along) / end_along, last = (half - mid_along) / end_along;
        low = maxf(low, minf(first, last));
        high = minf(high, maxf(first, last));
    } else if (ABS(mid_along) > half) {
        high = -2.f;
    }
    Touch t;
    t.n = low > high ? 0 : high - low > 1e-3f && reach > 0.f ? 2 : 1;
    float n_along = 0.f, n_above = up, corner_gap = 0.f;
    if (t.n == 0) {  // beside the side: a corner against its nearer end
        float at = ABS(mid_along + end_along) <= ABS(mid_along - end_along) ? 1.f : -1.f;
        float to_along = mid_along + at * end_along, to_above = mid_above + at * end_above;
        to_along -= signed_as(half, to_along);
        to_above -= up * height;
        corner_gap = SQRT(to_along * to_along + to_above * to_above);
        if (!(to_above * up > 0.f))
            return t;
        n_along = to_along / corner_gap;
        n_above = to_above / corner_gap;
        low = high = at;
        t.n = 1;
    }
    float turned = is_x ? 1.f : -1.f;  // the sign of cross products of (above, along)
    for (int i = 0; i < 2; i++) {
        float at = t.n == 1 ? 0.5f * (low + high) : i ? high : low;
        float at_along = mid_along + at * end_along, at_above = mid_above + at * end_above;
        t.gaps[i] = n_along != 0.f ? corner_gap : up * at_above - height;
        t.arms_a[i] = turned * (at_above * n_along - at_along * n_above);
        t.arms_b[i] = turned * ((at_above - above) * n_along - (at_along - along) * n_above);
    }
    float nx = is_x ? n_above : n_along, ny = is_x ? n_along : n_above;
    t.nx = own.cosine * nx - own.sine * ny;
    t.ny = own.sine * nx + own.cosine * ny;
    return is_a ? t : swapped(t);
}

RARE Touch touch(const Hull& a, const Hull& b) {
    if (is_disc(a))
        return is_disc(b) ? touch_discs(a, b) : swapped(touch_disc(b, a));
    return is_disc(b) ? touch_disc(a, b) : touch_boxes(a, b);
}

// The largest overlap of two hulls, as the smallest gap; a large number where nothing touches.
HD float gap_of(const Touch& t) {
    if (t.n == 0)
        return 1e9f;
    return t.n == 2 ? minf(t.gaps[0], t.gaps[1]) : t.gaps[0];
}
