// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N games, B lanes: B = N sides.
#pragma once

struct PongStepParams {
    int* games;                // (GAME_FIELDS, N) in and out: the fields of Game, in order
    const long long* actions;  // (B) 0 nothing, 1 up, 2 down; lane = env n_sides + side
    float* reward;             // (B) out, as the next six
    unsigned char* reset;      // (B)
    unsigned char* terminal;   // (B)
    unsigned char* truncated;  // (B)
    float* points_won;         // (B) fraction of a game's points where it ends; 0 elsewhere
    unsigned short* features;  // (B, N_FEATURES) fp16
    unsigned char* pixels;     // (B, ROWS, COLUMNS)
    int* error_flag;           // (1) out: see common/errors.h
    unsigned int key0;         // the seed
    unsigned int key1;
    int n_envs;         // N
    int n_sides;        // 2: both paddles act; 1: the left one, against the tracker
    int restart;        // 1: every environment starts a new game
    int points;         // needed to win a game
    int limit;          // steps per game
    int tracker_speed;  // per step
    int n_threads;      // CPU threads
};
