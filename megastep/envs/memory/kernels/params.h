// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N environments of one agent, D layouts, O objects.
#pragma once
#include "common/objects.h"
#include "common/scenery.h"

struct MemoryStepParams {
    SceneryParams scenery;
    ObjectsParams objects;
    const float* positions;     // (N, 1, 2) metres
    const float* angles;        // (N, 1) degrees
    const float* arrangements;  // (D, n_arrangements, O, 2) metres: where objects may lie
    int* cue;                   // (N) in and out, as the next four: the object to find
    int* found;                 // (N) objects found in this episode
    int* n_draws;               // (N) numbers drawn so far, the generator's counter
    int* ages;                  // (N) steps since the first observation
    unsigned char* ended;       // (N) in: starts an episode in this step; out: ends it in this step
    int* error_flag;            // (1) out: see common/errors.h
    float* reward;              // (N) out, as the next seven
    unsigned char* reset;       // (N)
    unsigned char* terminal;    // (N)
    unsigned char* truncated;   // (N)
    float* metrics;             // (N) objects found where an episode ends
    unsigned short* cue_obs;    // (N, 3) fp16: the colour of the object to find
    float* goal;                // (N, N_GOAL) for a critic, as the next; null: neither
    float* places;              // (N, O, 2) tens of metres ahead and to the left of the agent
    unsigned int key0;          // the seed
    unsigned int key1;
    int n_arrangements;  // per layout
    int limit;           // steps per episode
    float reach;         // metres between surfaces at which an agent touches an object
};
