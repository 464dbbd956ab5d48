// What the step of every game reads and writes.
//
// N environments, A agents per environment, B = N A lanes.
#pragma once
#include "common/scenery.h"

struct OutcomeParams {
    float* reward;             // (B) out, as the rest
    unsigned char* reset;      // (B)
    unsigned char* terminal;   // (B)
    unsigned char* truncated;  // (B)
    float* metrics;            // (n_metrics, B) of the episode where one ends, else 0
};

// Of a game in scenery.
struct GameParams : OutcomeParams {
    SceneryParams scenery;
    float* positions;      // (N, A, 2) metres
    const float* angles;   // (N, A) degrees
    int* ages;             // (N, A) in and out: steps since the first observation
    unsigned char* ended;  // (N, A) in: starts an episode in this step; out: ends it in this step
    int* error_flag;       // (1) out: see common/errors.h
    const unsigned char* only;  // (B) null, or the only lanes that take part, which all start one
};

// Of such a game that draws random numbers.
struct DrawnGameParams : GameParams {
    int* n_draws;       // (N), or (N, A), in and out: numbers drawn so far, the generator's counter
    unsigned int key0;  // the seed
    unsigned int key1;
};

// Of a game on a board.
struct BoardParams : OutcomeParams {
    int* games;                // (fields, N) in and out: the fields of the game's struct, in order
    const long long* actions;  // (B)
    int* error_flag;           // (1) out: see common/errors.h
    unsigned int key0;         // the seed
    unsigned int key1;
    int n_envs;     // N
    int limit;      // steps of an episode
    int n_threads;  // CPU threads
};

HD int takes_part(const GameParams& p, int i) { return !p.only || p.only[i]; }

// Whether lane i, which takes part, starts an episode.
HD int begins(const GameParams& p, int i) { return p.only || p.ended[i]; }

// Writes how lane i's step ends: the episode, if it `ends`, by the game's rule or by time.
HD void write_outcome(const OutcomeParams& p, int i, float reward, int reset, int ends, int rule) {
    p.reward[i] = reward;
    p.reset[i] = (unsigned char)reset;
    p.terminal[i] = (unsigned char)(ends && rule);
    p.truncated[i] = (unsigned char)(ends && !rule);
}

HD void write_outcome(const GameParams& p, int i, float reward, int reset, int age, int ends,
                      int rule) {
    p.ages[i] = age;
    p.ended[i] = (unsigned char)ends;
    write_outcome(p, i, reward, reset, ends, rule);
}

// The state of a game that is a struct of ints: (fields, N) in memory, the fields in their order.
template <class Game>
HD void load_game(Game& g, const int* games, long long n_envs, int env) {
    int* fields = (int*)&g;
    for (int i = 0; i < (int)(sizeof(Game) / sizeof(int)); i++)
        fields[i] = games[i * n_envs + env];
}

template <class Game>
HD void store_game(const Game& g, int* games, long long n_envs, int env) {
    const int* fields = (const int*)&g;
    for (int i = 0; i < (int)(sizeof(Game) / sizeof(int)); i++)
        games[i * n_envs + env] = fields[i];
}
