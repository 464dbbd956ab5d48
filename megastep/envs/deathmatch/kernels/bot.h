// The scripted bot: turns until another agent is at the centre of its view, keeps it there and
// approaches. If it sees none, it walks about and turns away from walls.
#pragma once
#include "common/group.h"
#include "params.h"

constexpr int NO_PIXEL = 0x7fffffff;

struct Glance {
    int pixel;  // the agents' pixel closest to the centre: twice its distance, times R, plus it
    int left, right;  // depth of either half, in integers, so that no order of adding matters
    int is_blocked;   // whether a wall near the centre is too near to walk
};

template <class Group>
HD Glance glance(const BotParams& p, const Group& group, int lane) {
    const unsigned short* rgb = p.rgb + 3ll * p.n_pixels * lane;
    const unsigned short* depth = p.depth + (long long)p.n_pixels * lane;
    int n = p.n_pixels, half = n / 2;
    Glance view = {NO_PIXEL, 0, 0, 0};
    for (int i = group.rank; i < n; i += Group::SIZE) {
        float red = HALF_VALUE(rgb[i]), green = HALF_VALUE(rgb[n + i]);
        float blue = HALF_VALUE(rgb[2 * n + i]), away = HALF_VALUE(depth[i]);
        float light = red + green + blue;
        if (minf(red, minf(green, blue)) < SATURATED * light && light > DARK)
            view.pixel = mini(view.pixel, maxi(2 * i - (n - 1), n - 1 - 2 * i) * n + i);
        int units = TO_INT(RINT(away * 65536.f));
        view.left += i < half ? units : 0;
        view.right += i < half ? 0 : units;
        view.is_blocked |= i >= half - MIDDLE && i < half + MIDDLE && !(away < NEAR);
    }
    return {reduce_min(group, view.pixel), reduce_add(group, view.left),
            reduce_add(group, view.right), (int)reduce_or(group, view.is_blocked)};
}

// The arc tangent in degrees (Cephes' atanf), the same on the CPU and on the GPU.
HD float atan_degrees(float x) {
    float size = maxf(x, -x), y = size, start = 0.f;
    if (size > 2.414213562f) {
        start = 90.f;
        y = -1.f / size;
    } else if (size > .414213562f) {
        start = 45.f;
        y = (size - 1.f) / (size + 1.f);
    }
    float z = y * y;
    float series = 8.05374449538e-2f * z - 1.38776856032e-1f;
    series = (series * z + 1.99777106478e-1f) * z - 3.33329491539e-1f;
    float angle = start + (series * z * y + y) * 57.29577951f;
    return x < 0.f ? -angle : angle;
}

// The turn that brings a bearing closest to 0 after some seconds.
HD int turn(float target, float spin, float seconds) {
    const int actions[3] = {RIGHT, NOTHING, LEFT};
    int best = RIGHT;
    float least = INF_VALUE;
    for (int i = 0; i < 3; i++) {
        float off = target - seconds * (RETAINED * spin + (float)(i - 1) * TURN);
        off = maxf(off, -off);
        best = off < least ? actions[i] : best;
        least = minf(off, least);
    }
    return best;
}

template <class Group>
HD void act(const BotParams& p, const Group& group, int lane) {
    Glance view = glance(p, group, lane);
    if (group.rank != 0)
        return;
    int n = p.n_pixels, is_seen = view.pixel != NO_PIXEL, reset = p.reset[lane];
    int pixel = is_seen ? view.pixel % n : 0;
    float target = atan_degrees((float)(n - 1 - 2 * pixel) / (float)n * p.slope);
    float spin = 360.f * HALF_VALUE(p.imu[3ll * lane]), ahead = HALF_VALUE(p.imu[3ll * lane + 1]);
    int is_stopped = p.pushed[lane] && ahead == 0.f && !reset;
    long long side = p.side[lane];
    if (is_seen)
        side = target > 0.f ? 1 : -1;
    else if (is_stopped)
        side = view.left * (long long)(n - n / 2) < view.right * (long long)(n / 2) ? 1 : -1;
    long long around = is_stopped ? AROUND : p.around[lane] - 1;
    around = around < 0 ? 0 : around;
    long long lost = is_seen ? 0 : reset ? LOOK : p.lost[lane] + 1;
    int walks = !view.is_blocked && !around && lost > LOOK;
    int action = walks ? FORWARD : side > 0 ? LEFT : RIGHT;
    if (is_seen) {
        int is_close = !(HALF_VALUE(p.depth[(long long)n * lane + pixel]) < CLOSE);
        action = turn(target, spin, maxf(target, -target) > 3.f ? 3.f * STEP : STEP);
        // a push makes it exactly that fast, but for rounding to fp16
        int is_slow = ahead < HALF_VALUE(HALF_BITS(SLOW));
        action = action == NOTHING && !is_close && is_slow ? FORWARD : action;
    }
    p.actions[lane] = action;
    p.next_lost[lane] = lost;
    p.next_side[lane] = side;
    p.next_around[lane] = around;
    p.next_pushed[lane] = action == FORWARD;
}

EACH_WARP(bot, BotParams, p.n_lanes, p.n_threads, act(p, group, i))
