// Breakout: a paddle returns a ball to three rows of bricks.
#pragma once
#include "board.h"

struct Breakout : Game {
    int x, y, last_x, last_y;
    int direction;  // 0 up left, 1 up right, 2 down right, 3 down left
    int paddle;
    int has_struck;  // a brick in the last step
    int bricks;      // bits, of rows 1 to 3
};
static_assert(sizeof(Breakout) == BREAKOUT_FIELDS * sizeof(int), "BREAKOUT_FIELDS");

constexpr int ALL_BRICKS = (1 << 3 * SIDE) - 1;

HD void begin(Breakout& g, const Env& e) {
    int is_right = draw_below(g, e, 2);
    g.x = g.last_x = is_right ? LAST : 0;
    g.y = g.last_y = 3;
    g.direction = is_right ? 3 : 2;
    g.paddle = 4;
    g.has_struck = 0;
    g.bricks = ALL_BRICKS;
}

// A ball that strikes a brick in the step after another one passes through it.
HD Outcome play(Breakout& g, const Env&, int action) {
    Outcome outcome = {0, 0};
    g.paddle = moved(g.paddle, action, LEFT, RIGHT, 0, LAST);
    g.last_x = g.x;
    g.last_y = g.y;
    int x = g.x + (g.direction == 1 || g.direction == 2 ? 1 : -1);
    int y = g.y + (g.direction >= 2 ? 1 : -1), is_at_brick = 0;
    if (x < 0 || x > LAST) {
        x = within(x, LAST);
        g.direction ^= 1;
    }
    int brick = y >= 1 && y <= 3 ? 1 << (SIDE * (y - 1) + x) : 0;
    if (y < 0) {
        y = 0;
        g.direction = 3 - g.direction;
    } else if (g.bricks & brick) {
        is_at_brick = 1;
        if (!g.has_struck) {
            outcome.reward = g.has_struck = 1;
            g.bricks &= ~brick;
            y = g.last_y;
            g.direction = 3 - g.direction;
        }
    } else if (y == LAST) {
        if (!g.bricks)
            g.bricks = ALL_BRICKS;
        if (g.x == g.paddle)
            g.direction = 3 - g.direction;
        else if (x == g.paddle)
            g.direction ^= 2;
        else
            outcome.is_terminal = 1;
        if (!outcome.is_terminal)
            y = g.last_y;
    }
    g.has_struck = g.has_struck && is_at_brick;
    g.x = x;
    g.y = y;
    return outcome;
}

// Channels: paddle, ball, trail, brick.
HD void observe(const Breakout& g, const Env&, unsigned int* bits) {
    set_cell(bits, 0, LAST, g.paddle);
    set_cell(bits, 1, g.y, g.x);
    set_cell(bits, 2, g.last_y, g.last_x);
    for (int i = 0; i < 3; i++)
        set_row(bits, 3, i + 1, (unsigned int)(g.bricks >> SIDE * i & ROW));
}
