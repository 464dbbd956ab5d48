// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N environments, A agents per environment, D layouts, S runs of texels of all layouts together.
#pragma once
#include "common/scenery.h"

struct ExplorerStepParams {
    SceneryParams scenery;
    const float* positions;    // (N, A, 2)
    const float* angles;       // (N, A)
    const int* newly_seen;     // (N, A) texels newly marked in seen
    const unsigned int* seen;  // (N, A, n_words) a bit per static texel
    const float* runs;         // (S, 4) see Run in explorer_step.h; null: nothing is counted
    const int* run_starts;     // (D + 1) first run of each layout
    const int* n_visible;      // (D) visible texels of each layout
    int* ages;                 // (N, A) in and out, as the next two: steps since the first
                               // observation
    int* limits;               // (N, A) age at which the episode is truncated
    unsigned char* ended;      // (N, A) in: starts an episode in this step; out: ends it here
    int* error_flag;           // (1) out: see common/errors.h
    float* reward;             // (N, A) out, as the next six
    unsigned char* reset;      // (N, A)
    unsigned char* terminal;   // (N, A)
    unsigned char* truncated;  // (N, A)
    float* coverage;           // (N, A) 0 where no episode ends; null: none
    float* episode;            // (N, A, N_EPISODE) steps left and taken, texels seen and left
    float* unseen;             // (N, A, BINS) null: none, and no episode
    int n_words;
    int patience;            // steps that an episode lasts beside one per texel seen
    float texels_per_point;  // texels seen for the first time that earn a reward of 1
};
