// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N environments, A agents per environment, M lines of the agent model.
#pragma once
#include "common/step.h"

constexpr int MAX_AGENTS = 16;              // per environment
constexpr int SUMS = 3;                     // of an episode so far: kills, damage, hits
constexpr int TALLY_ROWS = 4;               // these, and how well the agent aimed last
constexpr int PRIVILEGED_PER_OPPONENT = 5;  // numbers that a critic sees of each other agent

// The bot.
constexpr int NOTHING = 0;  // actions with momentum
constexpr int FORWARD = 3;
constexpr int LEFT = 5;
constexpr int RIGHT = 6;
constexpr float TURN = 18.0f;       // degrees per second added by an action
constexpr float RETAINED = 0.875f;  // fraction of a velocity left after a step
constexpr float STEP = 0.1f;        // seconds
constexpr float SATURATED = 0.12f;  // part of light in the weakest channel: agents less, walls more
constexpr float DARK = 0.01f;       // darker pixels are ignored
constexpr int LOOK = 25;            // steps it turns after it lost an agent: all round
constexpr int AROUND = 10;          // steps it turns away from what stopped it
constexpr float SLOW = 0.05f;       // maximum speed at which it approaches, in tens of metres/s
constexpr int MIDDLE = 8;           // pixels left and right of the centre that must be free to walk
constexpr float CLOSE = 0.7f;       // depth at 3 m, near enough to an agent
constexpr float NEAR = 0.9f;        // depth at 1 m, too near to a wall

// Metrics: kills, deaths, damage, accuracy.
struct DeathmatchStepParams : OutcomeParams {
    const int* centre_line;  // (N, A) line at the centre of each view, as Render.indices
    const int* agent_ray;    // (N, A) ray closest to the centre that hits an agent, or -1
    const int* newly_seen;   // (N, A) texels seen for the first time; null: they earn nothing
    const float* positions;  // (N, A, 2) for sound and privileged
    const float* angles;     // (N, A) for sound and privileged
    float* health;           // (N, A) in and out, as the next three: from 0 to 1
    float* tally;            // (TALLY_ROWS, N, A): kills, damage, hits so far; aim in the last step
    int* ages;               // (N, A) steps since the first observation
    int* round_ages;         // (N) steps of the round, -1: the next begins one; null: no rounds
    unsigned char* ended;    // (N, A) in: starts an episode in this step; out: ends it in this step
    unsigned short* health_obs;  // (N, A, 3) fp16, out, as the next two: health, whether it hit,
                                 // how many hit it
    unsigned short* sound;  // (N, A, 3) fp16: loudness, cosine and sine of where from; null: none
    float* privileged;      // (N, A, 1 + PRIVILEGED_PER_OPPONENT (A - 1)) for a critic; null: none
    float damage;           // health that a hit costs its target
    float recovery;         // health regained in a step without a wound
    float drain;            // health lost in every step
    float health_per_hit;   // health gained by an agent that hits
    const float* hit_reward;
    const float* wound_cost;
    const float* kill_reward;
    const float* death_cost;
    const float* aim_reward;  // for bringing an agent from the edge of the view to its centre
    float search_reward;      // per newly seen texel
    float hearing;            // metres at which sounds fade
    int limit;                // steps per episode
    int res;                  // rays per view
    int n_envs;               // N
    int n_agents;             // A
    int n_model;              // M
    int n_threads;            // CPU threads
};

// The actions of B lanes as the step takes them: 0 where an episode has ended.
struct ActionsOfLiveParams {
    const long long* actions;    // (B)
    const unsigned char* ended;  // (B)
    long long* out;              // (B)
    int n_lanes;
};

// B lanes, R pixels.
struct BotParams {
    const unsigned short* rgb;    // (B, 3, R) fp16
    const unsigned short* depth;  // (B, R) fp16
    const unsigned short* imu;    // (B, 3) fp16
    const unsigned char* reset;   // (B,)
    const long long* lost;        // (B,) the state; see Bot.initial
    const long long* side;
    const long long* around;
    const unsigned char* pushed;
    long long* actions;  // (B,) out, as the rest
    long long* next_lost;
    long long* next_side;
    long long* next_around;
    unsigned char* next_pushed;
    float slope;  // tangent of half the field of view
    int n_lanes;
    int n_pixels;   // R
    int n_threads;  // CPU threads
};
