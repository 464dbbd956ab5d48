// A loop over lanes.
#include "bot.h"

KERNEL bot(const BotParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int lane = 0; lane < p.n_lanes; lane++)
        decide(p, lane, glance(p, lane, 0, 1));
}
