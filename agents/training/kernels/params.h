// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes, G groups of lanes, D layouts, S sources of layouts.
#pragma once

struct EpisodeMetricParams {
    const float* values;  // (T, B)
};

struct EpisodesParams {
    EpisodeMetricParams metrics[8];
    const float* reward;          // (T, B)
    const unsigned char* reset;   // (T, B)
    const unsigned char* done;    // (T, B)
    const unsigned char* learns;  // (T, B); null: all
    const int* layouts;           // (T, B); null: no sums by source
    const int* source_of_layout;  // (D)
    double* returns;              // (B), of the episodes in progress, updated
    double* lengths;              // (B), updated
    unsigned char* is_whole;      // (B), updated
    double* sums;                 // (4 + 2 n_metrics, B)
    double* source_sums;          // (4 + 2 n_metrics, S, B)
    long long* bad_lanes;         // (n_metrics), updated
    int n_metrics;
    int n_sources;  // S
    int n_layouts;  // D
    int n_steps;
    int n_lanes;
    float limit;
};

struct EpisodeColumnsParams {
    const double* of_lanes;     // (n_sums, B)
    const double* members;      // (B, G), 1 for the lanes of a group, else 0
    const double* source_sums;  // (n_sums, S, B); null: there are no sources
    double* sums;               // (n_sums, G + S), updated
    int n_groups;               // G
    int n_lanes;
};
