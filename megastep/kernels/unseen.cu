// One block per agent, over the walls of its layout.
#include "unseen.h"

KERNEL BOUNDS(20) unseen(UnseenParams p) {
    wait_for_previous();
    __shared__ int bins[BINS];
    int agent = blockIdx.x;
    for (int i = threadIdx.x; i < BINS; i += BLOCK)
        bins[i] = 0;
    __syncthreads();
    count_unseen(p, agent, threadIdx.x, BLOCK, bins);
    __syncthreads();
    for (int i = threadIdx.x; i < BINS; i += BLOCK)
        p.counts[agent * (long long)BINS + i] = bins[i];
}
