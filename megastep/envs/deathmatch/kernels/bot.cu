// A warp per lane reads the pixels; one of its threads decides.
#include "bot.h"

KERNEL bot(BotParams p) {
    wait_for_previous();
    int lane = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (lane >= p.n_lanes)
        return;
    Glance view = glance(p, lane, threadIdx.x % WARP, WARP);
    for (int mask = WARP / 2; mask; mask /= 2) {
        view.pixel = mini(view.pixel, __shfl_xor_sync(FULL_WARP, view.pixel, mask));
        view.left += __shfl_xor_sync(FULL_WARP, view.left, mask);
        view.right += __shfl_xor_sync(FULL_WARP, view.right, mask);
        view.is_blocked |= __shfl_xor_sync(FULL_WARP, view.is_blocked, mask);
    }
    if (threadIdx.x % WARP == 0)
        decide(p, lane, view);
}
