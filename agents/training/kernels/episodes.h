// Sums over the episodes that end in a rollout, one thread per lane.
#pragma once
#include "common/math.h"

// T steps, B lanes, M metrics, D layouts, S sources of layouts, V = 4 + 3 M values of an episode.
struct EpisodesParams {
    const float* reward;          // (T, B)
    const unsigned char* reset;   // (T, B)
    const unsigned char* done;    // (T, B)
    const unsigned char* learns;  // (T, B)
    const float* metrics;         // (M, T, B); null: none
    const int* layouts;           // (T, B); null: no sums by source
    const int* source_of_layout;  // (D)
    double* totals;               // (2, B) in and out: return and length of the episode in progress
    unsigned char* is_whole;      // (B) in and out
    unsigned char* has_begun;     // (B) out: whether the episode in progress began in the rollout
    double* sums;                 // (1 + S, V, 2, B) in and out: of all and by source; of the
                                  // episode that was in progress before, and of those after it
    int n_metrics;
    int n_layouts;
    int n_steps;
    int n_lanes;
    int n_threads;  // CPU threads
    float limit;
};

// Adds an episode that ends at `at` to a lane's sums, of all episodes (0) or of a source.
HD void add_episode(const EpisodesParams& p, long long at, int lane, int column, int is_later,
                    double total, double length) {
    int n_values = 4 + 3 * p.n_metrics;
    long long row = 2ll * p.n_lanes;
    double* sums = p.sums + column * n_values * row + (is_later ? p.n_lanes : 0) + lane;
    sums[0] += 1.;
    sums[row] += total;
    sums[2 * row] += total * total;
    sums[3 * row] += length;
    for (int i = 0; i < p.n_metrics; i++) {
        float value = p.metrics[(long long)i * p.n_steps * p.n_lanes + at];
        int is_good = ABS(value) <= p.limit;
        sums[(4 + i) * row] += is_good ? (double)value : 0.;
        sums[(4 + p.n_metrics + i) * row] += is_good ? 0. : 1.;
        sums[(4 + 2 * p.n_metrics + i) * row] += is_good || value != value ? 0. : 1.;
    }
}

HD void count_lane(const EpisodesParams& p, int lane) {
    double total = p.totals[lane], length = p.totals[p.n_lanes + lane];
    int is_whole = p.is_whole[lane], is_later = 0, has_begun = 0;
    for (int t = 0; t < p.n_steps; t++) {
        long long at = (long long)t * p.n_lanes + lane;
        float reward = p.reward[at];
        total += ABS(reward) <= p.limit ? (double)reward : 0.;
        length += p.reset[at] ? 0. : 1.;
        has_begun |= p.reset[at] | p.done[at];
        if (!p.done[at])
            continue;
        if (is_whole && p.learns[at]) {
            add_episode(p, at, lane, 0, is_later, total, length);
            int layout = p.layouts ? p.layouts[at] : -1;
            if (layout >= 0 && layout < p.n_layouts)
                add_episode(p, at, lane, 1 + p.source_of_layout[layout], is_later, total, length);
        }
        total = length = 0.;
        is_whole = is_later = 1;
    }
    p.totals[lane] = total;
    p.totals[p.n_lanes + lane] = length;
    p.is_whole[lane] = (unsigned char)is_whole;
    p.has_begun[lane] = (unsigned char)(has_begun != 0);
}

EACH(episodes, EpisodesParams, p.n_lanes, p.n_threads, count_lane(p, i))
