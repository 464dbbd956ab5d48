// What MinAtar's games share: their parameters, random numbers, and boards of 10 x 10 cells.
#pragma once
#include "common/philox.h"
#include "common/step.h"

constexpr int SIDE = 10;  // cells along a side of the board

// Rows of every game's state.
constexpr int AGE = 0;
constexpr int N_DRAWS = 1;
constexpr int ENDED = 2;
constexpr int LAST_ACTION = 3;

// Games, the numbers of their states, and the channels of their observations.
constexpr int BREAKOUT = 0;
constexpr int BREAKOUT_FIELDS = 12;
constexpr int BREAKOUT_CHANNELS = 4;
constexpr int ASTERIX = 1;
constexpr int ASTERIX_FIELDS = 20;
constexpr int ASTERIX_CHANNELS = 4;
constexpr int FREEWAY = 2;
constexpr int FREEWAY_FIELDS = 15;
constexpr int FREEWAY_CHANNELS = 7;
constexpr int SEAQUEST = 3;
constexpr int SEAQUEST_FIELDS = 21;
constexpr int SEAQUEST_CHANNELS = 10;
constexpr int SPACE_INVADERS = 4;
constexpr int SPACE_INVADERS_FIELDS = 20;
constexpr int SPACE_INVADERS_CHANNELS = 6;

constexpr int LIST_FIELDS = 104;     // of Seaquest's lists: see seaquest.h
constexpr int FREEWAY_STEPS = 2501;  // of an episode of Freeway, which ends by itself

// N games with C channels.
struct MinAtarStepParams : BoardParams {
    int* lists;            // (LIST_FIELDS, N) in and out, of Seaquest; else null
    unsigned char* image;  // (N, C, SIDE, SIDE) out: 0 or 1
    unsigned int sticky;   // chance of repeating the last action, in units of 2**-32
    int n_channels;        // C
    int game;              // see above
    int is_ramping;        // whether games become harder
    int n_actions;         // those above are errors
    int action_set;        // the original's number of each action, four bits each
};

constexpr int LEFT = 1, UP = 2, RIGHT = 3, DOWN = 4, FIRE = 5;  // as the original numbers them
constexpr int CELLS = SIDE * SIDE, LAST = SIDE - 1, ROW = (1 << SIDE) - 1;
constexpr int WORDS = 32;  // hold the bits of ten channels
// Words below have a chance of a half and a third.
constexpr unsigned int HALF = 1u << 31, THIRD = 1431655765u;

// The rows that all games begin with.
struct Game {
    int age;  // steps of the episode
    int n_draws;
    int ended;
    int last_action;
};

struct Outcome {
    int reward, is_terminal;
};

// What a game needs beside its state.
struct Env {
    int* lists;
    long long n_envs;
    int env, is_ramping;
    unsigned int key0, key1;
};

HD unsigned int draw(Game& g, const Env& e) {
    unsigned int n = (unsigned int)g.n_draws;
    g.n_draws = (int)(n + 1u);
    return random_word(e.env, (int)n, e.key0, e.key1);
}

// A random integer in [0, n).
HD int draw_below(Game& g, const Env& e, int n) {
    return (int)((unsigned long long)draw(g, e) * (unsigned int)n >> 32);
}

// One step along an axis, which ends at `min` and `max`.
HD int moved(int x, int action, int back, int ahead, int min, int max) {
    return action == back ? maxi(min, x - 1) : action == ahead ? mini(max, x + 1) : x;
}

// Sets a cell of an observation, which is a bit in WORDS words.
HD void set_cell(unsigned int* bits, int channel, int y, int x) {
    int i = CELLS * channel + SIDE * within(y, LAST) + within(x, LAST);
    bits[i >> 5] |= 1u << (i & 31);
}

// Sets the cells of a row, by the bits of x.
HD void set_row(unsigned int* bits, int channel, int y, unsigned int row) {
    int i = CELLS * channel + SIDE * y, shift = i & 31;
    bits[i >> 5] |= row << shift;
    if (shift > 32 - SIDE)
        bits[(i >> 5) + 1] |= row >> (32 - shift);
}

// Sets where something was that moved to x, if that is on the board.
HD void set_trail(unsigned int* bits, int channel, int y, int x, int to_right) {
    int from = to_right ? x - 1 : x + 1;
    if (from >= 0 && from <= LAST)
        set_cell(bits, channel, y, from);
}

// Four cells of an observation as four bytes.
HD unsigned int bytes_of(const unsigned int* bits, int i) {
    unsigned int cells = bits[i >> 3] >> 4 * (i & 7) & 15u;
    return cells * 0x00204081u & 0x01010101u;
}
