// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N environments of one agent, D layouts, M episodes per layout, C colours, K doorways. Objects are
// C keys, the goal, then K doors.
#pragma once
#include "common/objects.h"
#include "common/scenery.h"

struct KeysStepParams {
    SceneryParams scenery;
    ObjectsParams objects;
    float* positions;          // (N, 1, 2) metres; out where an episode starts
    const float* angles;       // (N, 1) degrees
    const float* starts;       // (D, M, 2) metres
    const float* keys;         // (D, M, C, 2) metres, NaN: no such key
    const float* goals;        // (D, M, 2) metres
    const int* doors;          // (D, M, K) OPEN, a colour, or C, which stays locked
    const float* doorways;     // (D, K, 4) x, y, degrees, half the length
    int* opened;               // (N) in and out, as the next three: doors opened in this episode
    int* n_draws;              // (N) numbers drawn so far, the generator's counter
    int* ages;                 // (N) steps since the first observation
    unsigned char* ended;      // (N) in: starts an episode in this step; out: ends it in this step
    int* error_flag;           // (1) out: see common/errors.h
    float* reward;             // (N) out, as the next six
    unsigned char* reset;      // (N)
    unsigned char* terminal;   // (N)
    unsigned char* truncated;  // (N)
    float* metrics;            // (N_METRICS, N) where an episode ends
    unsigned short* keys_obs;  // (N, C) fp16: 1 for each key that the agent carries
    float* privileged;         // (N, 2 C + 3) for a critic; null: none
    unsigned int key0;         // the seed
    unsigned int key1;
    int n_episodes;            // M
    int n_colours;             // C
    int n_doorways;            // K
    int limit;                 // steps per episode
    float reach;               // metres between surfaces at which an agent touches an object
    const float* key_reward;   // (), for a key that is picked up
    const float* door_reward;  // (), for a door that is opened
};
