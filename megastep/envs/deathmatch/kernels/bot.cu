// The bot's operations of bot.py in one launch. A warp per lane reads the pixels, one of its
// threads decides.
#include "common/math.h"
#include "constants.h"
#include "params.h"

constexpr int NO_PIXEL = 0x7fffffff;

// What the bot needs of a view.
struct Glance {
    int pixel;        // the agents' pixel closest to the centre, times two its distance, times R
    int left, right;  // depth in either half: integers, so that no order of adding matters
    int is_blocked;
};

DEVICE Glance glance(const BotParams& p, int lane) {
    const unsigned short* rgb = p.rgb + 3ll * p.n_pixels * lane;
    const unsigned short* depth = p.depth + (long long)p.n_pixels * lane;
    int n = p.n_pixels, half = n / 2;
    Glance view = {NO_PIXEL, 0, 0, 0};
    for (int i = threadIdx.x % WARP; i < n; i += WARP) {
        float red = HALF_VALUE(rgb[i]), green = HALF_VALUE(rgb[n + i]);
        float blue = HALF_VALUE(rgb[2 * n + i]), away = HALF_VALUE(depth[i]);
        float light = red + green + blue;
        if (minf(red, minf(green, blue)) < SATURATED * light && light > DARK)
            view.pixel = mini(view.pixel, maxi(2 * i - (n - 1), n - 1 - 2 * i) * n + i);
        (i < half ? view.left : view.right) += TO_INT(RINT(away * 65536.f));
        view.is_blocked |= i >= half - MIDDLE && i < half + MIDDLE && !(away < NEAR);
    }
    for (int mask = WARP / 2; mask; mask /= 2) {
        view.pixel = mini(view.pixel, __shfl_xor_sync(FULL_WARP, view.pixel, mask));
        view.left += __shfl_xor_sync(FULL_WARP, view.left, mask);
        view.right += __shfl_xor_sync(FULL_WARP, view.right, mask);
        view.is_blocked |= __shfl_xor_sync(FULL_WARP, view.is_blocked, mask);
    }
    return view;
}

// The turn that brings a bearing closest to 0 after some seconds.
DEVICE int turn(float target, float spin, float seconds) {
    const int actions[3] = {RIGHT, NOTHING, LEFT};
    int best = RIGHT;
    float least = INF_VALUE;
    for (int i = 0; i < 3; i++) {
        float off = target - seconds * (RETAINED * spin + (float)(i - 1) * TURN);
        if (fabsf(off) < least) {
            least = fabsf(off);
            best = actions[i];
        }
    }
    return best;
}

KERNEL bot(BotParams p) {
    int lane = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, n = p.n_pixels;
    if (lane >= p.n_lanes)
        return;
    Glance view = glance(p, lane);
    if (threadIdx.x % WARP)
        return;
    bool is_seen = view.pixel != NO_PIXEL, reset = p.reset[lane];
    int pixel = is_seen ? view.pixel % n : 0;
    float slope = (float)(n - 1 - 2 * pixel) / (float)n;
    float target = atanf(slope * p.slope) * 57.29578f;
    float spin = 360.f * HALF_VALUE(p.imu[3 * lane]), ahead = HALF_VALUE(p.imu[3 * lane + 1]);
    bool is_stopped = p.pushed[lane] && ahead == 0.f && !reset;
    long long side = p.side[lane];
    if (is_seen)
        side = target > 0.f ? 1 : -1;
    else if (is_stopped)
        side = view.left * (long long)(n - n / 2) < view.right * (long long)(n / 2) ? 1 : -1;
    long long around = is_stopped ? AROUND : p.around[lane] - 1;
    around = around < 0 ? 0 : around;
    long long lost = is_seen ? 0 : reset ? LOOK : p.lost[lane] + 1;
    bool walks = !view.is_blocked && !around && lost > LOOK;
    int action = walks ? FORWARD : side > 0 ? LEFT : RIGHT;
    if (is_seen) {
        bool is_close = HALF_VALUE(p.depth[(long long)n * lane + pixel]) >= CLOSE;
        action = turn(target, spin, fabsf(target) > 3.f ? 3.f * STEP : STEP);
        action = action == NOTHING && !is_close && ahead < SLOW ? FORWARD : action;
    }
    p.actions[lane] = action;
    p.next_lost[lane] = lost;
    p.next_side[lane] = side;
    p.next_around[lane] = around;
    p.next_pushed[lane] = action == FORWARD;
}
