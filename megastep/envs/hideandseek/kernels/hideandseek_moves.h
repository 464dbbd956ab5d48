// The actions by which agents move in a step: none of those that grab, wait or begin an episode.
#pragma once
#include "common/backend.h"
#include "constants.h"

// The actions of B lanes as agents move by them: 0 of those that cannot move, or do not.
struct HideAndSeekMovesParams {
    const long long* actions;    // (B)
    const int* ages;             // (B)
    const unsigned char* ended;  // (B)
    long long* out;              // (B)
    int n_lanes;                 // B
    int n_agents;                // A
    int n_hiders;
    int prep;
};

// Returns 1 if an action of lane i moves it.
HD int is_move(const HideAndSeekMovesParams& p, int i) {
    int waits = p.ages[i] < p.prep && i % p.n_agents >= p.n_hiders;
    return !p.ended[i] && !waits && p.actions[i] < GRAB;
}

EACH(hideandseek_moves, HideAndSeekMovesParams, p.n_lanes, 1,
     p.out[i] = is_move(p, i) ? p.actions[i] : 0)
