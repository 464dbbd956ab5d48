// Pong: two paddles return a ball between two walls, 40 x 30 cells. All is counted in integers, 256
// to a cell, so that there is nothing to round. The left side is told what the right is, mirrored.
#pragma once
#include "errors.h"
#include "params.h"
#include "philox.h"

constexpr int CELL = 256;
constexpr int WIDTH = 40 * CELL, HEIGHT = 30 * CELL;
constexpr int PADDLE = 4 * CELL, LOWEST = HEIGHT - PADDLE;
constexpr int PADDLE_SPEED = CELL;                        // per step, of a side that acts
constexpr int WORDS = 150;                                // of 8 pixels per picture, 5 per row
constexpr int BALL = 255, PADDLE_GREY = 170, TRAIL = 85;  // in a picture
constexpr int GAME_FIELDS = 13, N_FEATURES = 8;

struct Game {
    int x, y;            // the ball
    int vx, vy;          // per step
    int last_x, last_y;  // the ball a step ago
    int top[2];          // of the paddles: left, right
    int score[2];
    int age;    // steps since the first observation
    int draws;  // from the random stream
    int ended;
};

HD void load_game(Game& g, const int* games, long long n_envs, int env) {
    int* fields = (int*)&g;
    for (int i = 0; i < GAME_FIELDS; i++)
        fields[i] = games[i * n_envs + env];
}

HD void store_game(const Game& g, int* games, long long n_envs, int env) {
    const int* fields = (const int*)&g;
    for (int i = 0; i < GAME_FIELDS; i++)
        games[i * n_envs + env] = fields[i];
}

// From the middle, at any height, to either side, up to half a cell up or down per step.
HD void serve(Game& g, const PongParams& p, int env) {
    Philox bits = philox((unsigned int)env, (unsigned int)g.draws++, p.key0, p.key1);
    int to_right = (int)(bits.c >> 31);
    g.last_x = g.x = WIDTH / 2 - to_right;
    g.last_y = g.y = (int)((bits.a >> 16) * (unsigned int)HEIGHT >> 16);
    g.vx = to_right ? CELL : -CELL;
    g.vy = (int)((bits.b >> 16) * (unsigned int)(CELL + 1) >> 16) - CELL / 2;
}

HD void new_game(Game& g, const PongParams& p, int env) {
    g.top[0] = g.top[1] = LOWEST / 2;
    g.score[0] = g.score[1] = g.age = g.ended = 0;
    serve(g, p, env);
}

HD int between(int x, int min, int max) { return maxi(min, mini(x, max)); }

// What an action moves a paddle by: 0 nothing, 1 up, 2 down. Others are flagged, and do nothing.
HD int paddle_move(const PongParams& p, int env, int lane) {
    long long action = p.actions[lane];
    if (action < 0 || action > 2)
        flag_error(p.error_flag, env, BAD_ACTION);
    return action == 1 ? -PADDLE_SPEED : action == 2 ? PADDLE_SPEED : 0;
}

// The tracker's paddle follows the ball, as fast as it can.
HD int tracker_move(const PongParams& p, const Game& g) {
    return between(g.y - PADDLE / 2 - g.top[1], -p.tracker_speed, p.tracker_speed);
}

// A ball in a side's column is returned if the paddle is there, more steeply the further from its
// middle. Returns 1 for a miss.
HD int missed(Game& g, int side) {
    int below = g.y - g.top[side];
    if (below < 0 || below >= PADDLE)
        return 1;
    g.x = side ? 2 * (WIDTH - CELL) - 1 - g.x : 2 * CELL - 1 - g.x;
    g.vx = -g.vx;
    g.vy = (2 * below - (PADDLE - 1)) / 4;
    return 0;
}

// One step of one environment. Returns the side that wins a point, or -1.
HD int play(Game& g, const PongParams& p, int env) {
    int lane = env * p.n_sides;
    int right = p.n_sides == 2 ? paddle_move(p, env, lane + 1) : tracker_move(p, g);
    g.top[0] = between(g.top[0] + paddle_move(p, env, lane), 0, LOWEST);
    g.top[1] = between(g.top[1] + right, 0, LOWEST);
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

// What a world says of the lanes of an environment, whose last point went to `winner`, if any.
HD void write_outcome(const PongParams& p, const Game& g, int env, int reset, int winner,
                      int terminal) {
    for (int side = 0; side < p.n_sides; side++) {
        int lane = env * p.n_sides + side, n_points = g.score[0] + g.score[1];
        p.reward[lane] = winner < 0 ? 0.f : winner == side ? 1.f : -1.f;
        p.reset[lane] = (unsigned char)reset;
        p.terminal[lane] = (unsigned char)terminal;
        p.truncated[lane] = (unsigned char)(g.ended && !terminal);
        float share = 0.f;
        if (g.ended)
            share = n_points ? (float)g.score[side] / (float)n_points : 0.5f;
        p.points_won[lane] = share;
    }
}

// How far the ball is below the middle of a paddle: 1 at its edge, and no more than 2.
HD float offset(const Game& g, int side) {
    int doubled = 2 * (g.y - g.top[side]) - (PADDLE - 1);
    return (float)between(doubled, -2 * PADDLE, 2 * PADDLE) * (1.f / PADDLE);
}

// Places from -1 to 1, speeds in cells: own paddle, the other, ball, its velocity, and the ball as
// each paddle has it.
HD void write_features(const PongParams& p, const Game& g, int lane, int side) {
    const float across = 2.f / WIDTH, down = 2.f / HEIGHT, paddle = 2.f / LOWEST, cell = 1.f / CELL;
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

// What is in a side's picture: the rows at which the paddles begin, and two pixels.
struct Picture {
    int own, other, ball, trail;
};

HD int pixel_at(int x, int y, int side) {
    int column = (side ? WIDTH - 1 - x : x) / CELL;
    return y / CELL * (WIDTH / CELL) + column;
}

HD Picture picture_of(const Game& g, int side) {
    return {g.top[side] / CELL, g.top[1 - side] / CELL, pixel_at(g.x, g.y, side),
            pixel_at(g.last_x, g.last_y, side)};
}

// One step, but for the picture. Returns the game.
HD Game pong_env(const PongParams& p, int env) {
    Game g;
    load_game(g, p.games, p.n_envs, env);
    int reset = p.restart || g.ended, winner = -1, terminal = 0;
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
    write_outcome(p, g, env, reset, winner, terminal);
    if (p.features)
        for (int side = 0; side < p.n_sides; side++)
            write_features(p, g, env * p.n_sides + side, side);
    return g;
}
