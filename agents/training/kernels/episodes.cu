// Sums over the episodes that end in a rollout, one thread per lane; and over lanes. Sums by source
// are in global memory, where each thread has a column of its own: a lane ends an episode in few of
// its steps.
#include "common/constants.h"
#include "common/dependent_launch.h"
#include "constants.h"
#include "params.h"

#define BOUNDS(n_threads) __launch_bounds__(n_threads)

KERNEL episodes(EpisodesParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane >= p.n_lanes)
        return;
    double n = 0., sum = 0., square = 0., steps = 0.;
    double totals[EPISODE_METRICS] = {}, left_out[EPISODE_METRICS] = {};
    double episode_return = p.returns[lane], length = p.lengths[lane];
    bool is_whole = p.is_whole[lane];
    long long row = (long long)p.n_sources * p.n_lanes;  // of source_sums
    if (p.layouts)
        for (long long i = lane; i < (4 + 2 * p.n_metrics) * row; i += p.n_lanes)
            p.source_sums[i] = 0.;
#pragma unroll 8
    for (int t = 0; t < p.n_steps; t++) {
        long long at = (long long)t * p.n_lanes + lane;
        float reward = p.reward[at];
        episode_return += fabsf(reward) <= p.limit ? reward : 0.f;
        length += p.reset[at] ? 0. : 1.;
        if (!p.done[at])
            continue;
        if (is_whole && (!p.learns || p.learns[at])) {
            n += 1.;
            sum += episode_return;
            square += episode_return * episode_return;
            steps += length;
            double* own = nullptr;
            int layout = p.layouts ? p.layouts[at] : -1;
            if (layout >= 0 && layout < p.n_layouts) {
                own = p.source_sums + (long long)p.source_of_layout[layout] * p.n_lanes + lane;
                own[0] += 1.;
                own[row] += episode_return;
                own[2 * row] += episode_return * episode_return;
                own[3 * row] += length;
            }
#pragma unroll
            for (int i = 0; i < EPISODE_METRICS; i++)
                if (i < p.n_metrics) {
                    float value = p.metrics[i].values[at];
                    bool is_good = fabsf(value) <= p.limit;
                    totals[i] += is_good ? value : 0.f;
                    left_out[i] += is_good ? 0. : 1.;
                    if (own) {
                        own[(4 + i) * row] += is_good ? value : 0.f;
                        own[(4 + p.n_metrics + i) * row] += is_good ? 0. : 1.;
                    }
                }
        }
        episode_return = length = 0.;
        is_whole = true;
    }
    p.returns[lane] = episode_return;
    p.lengths[lane] = length;
    p.is_whole[lane] = is_whole;
    double* sums = p.sums + lane;
    sums[0] = n;
    sums[p.n_lanes] = sum;
    sums[2ll * p.n_lanes] = square;
    sums[3ll * p.n_lanes] = steps;
#pragma unroll
    for (int i = 0; i < EPISODE_METRICS; i++)
        if (i < p.n_metrics) {
            sums[(4ll + i) * p.n_lanes] = totals[i];
            sums[(4ll + p.n_metrics + i) * p.n_lanes] = left_out[i];
            if (left_out[i] > 0.)
                atomicMin(p.bad_lanes + i, (long long)lane);  // the same whatever the order
        }
}

// Adds a column up over lanes, in a fixed order. Blocks along x: columns, of groups, then of
// sources; along y: sums.
KERNEL BOUNDS(256) episode_columns(EpisodeColumnsParams p) {
    wait_for_previous();
    int column = blockIdx.x, n_sources = gridDim.x - p.n_groups;
    bool is_source = column >= p.n_groups;
    long long row =
        is_source ? (long long)blockIdx.y * n_sources + column - p.n_groups : blockIdx.y;
    const double* values = (is_source ? p.source_sums : p.of_lanes) + row * p.n_lanes;
    double sum = 0.;
#pragma unroll 4
    for (int lane = threadIdx.x; lane < p.n_lanes; lane += COLUMNS_THREADS)
        sum += values[lane] * (is_source ? 1. : p.members[(long long)lane * p.n_groups + column]);
    for (int mask = WARP / 2; mask; mask /= 2)
        sum += __shfl_xor_sync(~0u, sum, mask);
    __shared__ double of_warps[COLUMNS_THREADS / WARP];
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = sum;
    __syncthreads();
    if (threadIdx.x)
        return;
    sum = 0.;
    for (int warp = 0; warp < COLUMNS_THREADS / WARP; warp++)
        sum += of_warps[warp];
    p.sums[blockIdx.y * gridDim.x + column] += sum;
}
