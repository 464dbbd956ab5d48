// Pong: two paddles return a ball between two walls. Positions and speeds are integers, CELL units
// per cell, so nothing is rounded. Both sides observe the game as if they were the left one: the
// right side sees it mirrored.
#pragma once
#include "common/philox.h"
#include "common/step.h"

constexpr int ROWS = 30;     // of the court, in cells; a cell is one pixel
constexpr int COLUMNS = 40;  // of the court, in cells
constexpr int CELL = 256;    // units per cell: positions and speeds are integers
constexpr int PADDLE_ROWS = 4;
constexpr int BALL_GREY = 255;
constexpr int PADDLE_GREY = 170;
constexpr int TRAIL_GREY = 85;   // where the ball was one step ago
constexpr int GAME_FIELDS = 13;  // of struct Game
constexpr int N_FEATURES = 8;    // of an observation

// N games, B lanes: B = N sides. Metric: the fraction of a game's points.
struct PongStepParams : BoardParams {
    unsigned short* features;  // (B, N_FEATURES) fp16, out, as the next; null: none
    unsigned char* pixels;     // (B, ROWS, COLUMNS) null: none
    int n_sides;               // 2: both paddles act; 1: the left one, against the tracker
    int points;                // needed to win a game
    int tracker_speed;         // per step
};

constexpr int WIDTH = COLUMNS * CELL, HEIGHT = ROWS * CELL;
constexpr int PADDLE = PADDLE_ROWS * CELL, MAX_TOP = HEIGHT - PADDLE;
constexpr int PADDLE_SPEED = CELL;         // per step, of a side that acts
constexpr int WORDS = ROWS * COLUMNS / 8;  // of 8 pixels, per image

struct Game {
    int x, y;            // the ball
    int vx, vy;          // per step
    int last_x, last_y;  // the ball a step ago
    int top[2];          // of the paddles: left, right
    int score[2];
    int age;      // steps since the first observation
    int n_draws;  // numbers drawn so far, the generator's counter
    int ended;
};
static_assert(sizeof(Game) == GAME_FIELDS * sizeof(int), "GAME_FIELDS");

// Serves from the centre at a random height, to a random side, up to half a cell up or down per
// step.
HD void serve(Game& g, const PongStepParams& p, int env) {
    Philox bits = philox((unsigned int)env, (unsigned int)g.n_draws++, p.key0, p.key1);
    int to_right = (int)(bits.c >> 31);
    g.last_x = g.x = WIDTH / 2 - to_right;
    g.last_y = g.y = (int)((bits.a >> 16) * (unsigned int)HEIGHT >> 16);
    g.vx = to_right ? CELL : -CELL;
    g.vy = (int)((bits.b >> 16) * (unsigned int)(CELL + 1) >> 16) - CELL / 2;
}

HD void new_game(Game& g, const PongStepParams& p, int env) {
    g.top[0] = g.top[1] = MAX_TOP / 2;
    g.score[0] = g.score[1] = g.age = g.ended = 0;
    serve(g, p, env);
}

HD int between(int x, int min, int max) { return maxi(min, mini(x, max)); }

// How far an action moves a paddle: 0 nothing, 1 up, 2 down. Other actions are flagged and do
// nothing.
HD int paddle_move(const PongStepParams& p, int env, int lane) {
    long long action = p.actions[lane];
    if (action < 0 || action > 2)
        flag_error(p.error_flag, env, BAD_ACTION);
    return action == 1 ? -PADDLE_SPEED : action == 2 ? PADDLE_SPEED : 0;
}

// The tracker's paddle follows the ball, by at most tracker_speed.
HD int tracker_move(const PongStepParams& p, const Game& g) {
    return between(g.y - PADDLE / 2 - g.top[1], -p.tracker_speed, p.tracker_speed);
}

// Handles a ball in a side's column. The paddle, if it is there, returns the ball, more steeply the
// further from its centre. Returns 1 if the side misses.
HD int missed(Game& g, int side) {
    int below = g.y - g.top[side];
    if (below < 0 || below >= PADDLE)
        return 1;
    g.x = side ? 2 * (WIDTH - CELL) - 1 - g.x : 2 * CELL - 1 - g.x;
    g.vx = -g.vx;
    g.vy = (2 * below - (PADDLE - 1)) / 4;
    return 0;
}

// Moves paddles and ball by one step. Returns the side that wins a point, or -1.
HD int play(Game& g, const PongStepParams& p, int env) {
    int lane = env * p.n_sides;
    int right = p.n_sides == 2 ? paddle_move(p, env, lane + 1) : tracker_move(p, g);
    g.top[0] = between(g.top[0] + paddle_move(p, env, lane), 0, MAX_TOP);
    g.top[1] = between(g.top[1] + right, 0, MAX_TOP);
    g.last_x = g.x;
    g.last_y = g.y;
    g.x += g.vx;
    g.y += g.vy;
    if (g.y < 0 || g.y >= HEIGHT) {
        g.y = g.y < 0 ? -1 - g.y : 2 * HEIGHT - 1 - g.y;
        g.vy = -g.vy;
    }
    if (g.x < CELL)
        return missed(g, 0) ? 1 : -1;
    if (g.x >= WIDTH - CELL)
        return missed(g, 1) ? 0 : -1;
    return -1;
}

// Writes rewards and flags of an environment's lanes. `winner` is the side that won a point, or -1.
HD void write_outcomes(const PongStepParams& p, const Game& g, int env, int reset, int winner,
                       int terminal) {
    for (int side = 0; side < p.n_sides; side++) {
        int lane = env * p.n_sides + side, n_points = g.score[0] + g.score[1];
        float reward = winner < 0 ? 0.f : winner == side ? 1.f : -1.f;
        write_outcome(p, lane, reward, reset, g.ended, terminal);
        float metrics = 0.f;
        if (g.ended)
            metrics = n_points ? (float)g.score[side] / (float)n_points : 0.5f;
        p.metrics[lane] = metrics;
    }
}

// How far the ball is below the centre of a paddle: 1 at the paddle's edge, clamped to [-2, 2].
HD float offset(const Game& g, int side) {
    int doubled = 2 * (g.y - g.top[side]) - (PADDLE - 1);
    return (float)between(doubled, -2 * PADDLE, 2 * PADDLE) * (1.f / PADDLE);
}

// Features: positions in [-1, 1] of the side's paddle, the other paddle and the ball (x, y); the
// ball's velocity (x, y) in cells per step; the ball's offset from the side's paddle and from the
// other.
HD void write_features(const PongStepParams& p, const Game& g, int lane, int side) {
    const float across = 2.f / WIDTH, down = 2.f / HEIGHT, paddle = 2.f / MAX_TOP,
                cell = 1.f / CELL;
    int x = side ? WIDTH - 1 - g.x : g.x, vx = side ? -g.vx : g.vx;
    unsigned short* out = p.features + N_FEATURES * (long long)lane;
    out[0] = HALF_BITS((float)g.top[side] * paddle - 1.f);
    out[1] = HALF_BITS((float)g.top[1 - side] * paddle - 1.f);
    out[2] = HALF_BITS((float)x * across - 1.f);
    out[3] = HALF_BITS((float)g.y * down - 1.f);
    out[4] = HALF_BITS((float)vx * cell);
    out[5] = HALF_BITS((float)g.vy * cell);
    out[6] = HALF_BITS(offset(g, side));
    out[7] = HALF_BITS(offset(g, 1 - side));
}

// A side's image: the top rows of both paddles, and the pixels of the ball and its trail, all on
// the court, whatever was written into `games`.
struct Image {
    int own_top, other_top, ball, trail;
};

HD int pixel_at(int x, int y, int side) {
    x = within(x, WIDTH - 1);
    int column = (side ? WIDTH - 1 - x : x) / CELL;
    return within(y, HEIGHT - 1) / CELL * COLUMNS + column;
}

HD Image image_of(const Game& g, int side) {
    int own = within(g.top[side], MAX_TOP), other = within(g.top[1 - side], MAX_TOP);
    return {own / CELL, other / CELL, pixel_at(g.x, g.y, side), pixel_at(g.last_x, g.last_y, side)};
}

// One step, except for the image. Returns the game.
HD Game pong_env(const PongStepParams& p, int env) {
    Game g;
    load_game(g, p.games, p.n_envs, env);
    int reset = g.ended != 0, winner = -1, terminal = 0;
    if (reset) {
        new_game(g, p, env);
    } else {
        winner = play(g, p, env);
        g.age++;
        if (winner >= 0)
            terminal = ++g.score[winner] == p.points;
        g.ended = terminal || g.age >= p.limit;
        if (winner >= 0 && !g.ended)
            serve(g, p, env);
    }
    store_game(g, p.games, p.n_envs, env);
    write_outcomes(p, g, env, reset, winner, terminal);
    if (p.features)
        for (int side = 0; side < p.n_sides; side++)
            write_features(p, g, env * p.n_sides + side, side);
    return g;
}
