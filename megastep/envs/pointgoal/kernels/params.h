// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N environments, A agents per environment, D layouts.
#pragma once
#include "common/scenery.h"

struct PointgoalStepParams {
    SceneryParams scenery;
    const float* positions;  // (N, A, 2)
    const float* angles;     // (N, A)
    const float* free;       // (N, A) fraction of the step that was free; null: no step was taken
    const int* spawn_index;  // (N, A) spawn point of the layout, where an episode starts
    const float* points;     // (D, n_goals, 2) the goals
    const unsigned short* fields;  // fp16, per layout (n_goals, height, width): metres to the goal
    const long long* starts;       // (D) first cell of each layout's fields
    const int* shapes;             // (D, 2) height, width
    const float* origins;          // (D, 2) the centre of the first cell
    const float* lengths;          // (D, n_spawns, n_goals) of the shortest paths
    const int* in_range;    // (D, n_spawns, n_goals) goals; those that may be drawn come first
    const int* n_in_range;  // (D, n_spawns) number of goals that may be drawn
    int* n_draws;           // (N, A) in and out, as the next four: numbers drawn so far
    int* goal_index;        // (N, A) the agent's goal, of its layout's
    float* progress;        // (PROGRESS_ROWS, N, A) see constants.h
    int* ages;              // (N, A) steps since the first observation
    unsigned char* ended;   // (N, A) in: starts an episode in this step; out: ends it in this step
    int* error_flag;        // (1) out: see common/errors.h
    float* reward;          // (N, A) out, as the next six
    unsigned char* reset;   // (N, A)
    unsigned char* terminal;   // (N, A)
    unsigned char* truncated;  // (N, A)
    float* metrics;            // (4, N, A) success, SPL, soft SPL, collisions where an episode ends
    unsigned short* goal_obs;  // (N, A, 3) fp16: distance / 10 m, cosine and sine of the bearing
    float* privileged;         // (N, A, N_PRIVILEGED) for a critic; null: none
    unsigned int key0;         // the seed
    unsigned int key1;
    float per_cell;  // cells per metre
    float reach;     // metres: success within this distance of the goal
    float bonus;     // reward for success
    float cost;      // reward subtracted per step
    int limit;       // steps per episode
    int n_goals;     // per layout
    int n_spawns;    // per layout
};
