// Space Invaders: a cannon shoots at a block of aliens, which comes down and shoots back.
#pragma once
#include "board.h"

struct SpaceInvaders : Game {
    int x;
    int to_right;       // whether aliens move to the right
    int move_interval;  // steps between moves of many aliens
    int move_timer;     // of the aliens
    int alien_shot_timer;
    int shot_timer;  // of the cannon
    int rows[SIDE];  // bits: ten of aliens, ten of the cannon's bullets, ten of theirs
};
static_assert(sizeof(SpaceInvaders) == SPACE_INVADERS_FIELDS * sizeof(int),
              "SPACE_INVADERS_FIELDS");

constexpr int OWN_BULLETS = ROW << SIDE, ALIEN_BULLETS = ROW << 2 * SIDE;
constexpr int SHOT_INTERVAL = 5, ALIEN_SHOT_INTERVAL = 10, MAX_INTERVAL = 12, MIN_INTERVAL = 6;

HD void place_aliens(SpaceInvaders& g) {
    for (int y = 0; y < 4; y++)
        g.rows[y] |= 63 << 2;
}

HD int has_alien(const SpaceInvaders& g, int y, int x) { return g.rows[y] >> x & 1; }

HD void begin(SpaceInvaders& g, const Env&) {
    g.x = 5;
    g.to_right = 0;
    g.move_interval = g.move_timer = MAX_INTERVAL;
    g.alien_shot_timer = ALIEN_SHOT_INTERVAL;
    g.shot_timer = 0;
    for (int y = 0; y < SIDE; y++)
        g.rows[y] = 0;
    place_aliens(g);
}

HD int count_aliens(const SpaceInvaders& g) {
    int n = 0;
    for (int y = 0; y < SIDE; y++)
        n += (int)COUNT_BITS((unsigned int)(g.rows[y] & ROW));
    return n;
}

// Moves the cannon's bullets up and the aliens' down, and those at the edge away.
HD void move_bullets(SpaceInvaders& g) {
    int above = 0;
    for (int y = 0; y < SIDE; y++) {
        int row = g.rows[y], below = y < LAST ? g.rows[y + 1] : 0;
        g.rows[y] = (row & ROW) | (below & OWN_BULLETS) | (above & ALIEN_BULLETS);
        above = row;
    }
}

// Moves the aliens to the side, or down where they would leave the board. Returns whether they
// already were in the last row.
HD int move_aliens(SpaceInvaders& g) {
    int columns = 0, is_low = 0;
    for (int y = 0; y < SIDE; y++)
        columns |= g.rows[y];
    if (columns >> (g.to_right ? LAST : 0) & 1) {
        g.to_right = !g.to_right;
        is_low = (g.rows[LAST] & ROW) != 0;
        int above = g.rows[LAST] & ROW;
        for (int y = 0; y < SIDE; y++) {
            int row = g.rows[y] & ROW;
            g.rows[y] = (g.rows[y] & ~ROW) | above;
            above = row;
        }
    } else {
        for (int y = 0; y < SIDE; y++) {
            int row = g.rows[y] & ROW;
            g.rows[y] = (g.rows[y] & ~ROW) | ((g.to_right ? row << 1 : row >> 1) & ROW);
        }
    }
    return is_low;
}

// The lowest alien in the column nearest to the cannon shoots: of two as near, the left one.
HD void alien_shoots(SpaceInvaders& g, int cannon) {
    for (int i = 0; i < 2 * SIDE; i++) {
        int x = i & 1 ? cannon - (i + 1) / 2 : cannon + i / 2;
        if (x < 0 || x > LAST)
            continue;
        for (int y = LAST; y >= 0; y--)
            if (has_alien(g, y, x)) {
                g.rows[y] |= 1 << (2 * SIDE + x);
                return;
            }
    }
}

HD Outcome play(SpaceInvaders& g, const Env& e, int action) {
    Outcome outcome = {0, 0};
    int x = within(g.x, LAST);
    if (action == FIRE && g.shot_timer == 0) {
        g.rows[LAST] |= 1 << (SIDE + x);
        g.shot_timer = SHOT_INTERVAL;
    }
    g.x = x = moved(x, action, LEFT, RIGHT, 0, LAST);
    move_bullets(g);
    outcome.is_terminal = has_alien(g, LAST, x) || g.rows[LAST] >> (2 * SIDE + x) & 1;
    if (g.move_timer == 0) {
        g.move_timer = mini(count_aliens(g), g.move_interval);
        outcome.is_terminal |= move_aliens(g);
        outcome.is_terminal |= has_alien(g, LAST, x);
    }
    if (g.alien_shot_timer == 0) {
        g.alien_shot_timer = ALIEN_SHOT_INTERVAL;
        alien_shoots(g, x);
    }
    for (int y = 0; y < SIDE; y++) {
        int struck = g.rows[y] & g.rows[y] >> SIDE & ROW;
        outcome.reward += (int)COUNT_BITS((unsigned int)struck);
        g.rows[y] &= ~(struck | struck << SIDE);
    }
    g.shot_timer -= g.shot_timer > 0;
    g.move_timer--;
    g.alien_shot_timer--;
    if (!count_aliens(g)) {
        g.move_interval -= e.is_ramping && g.move_interval > MIN_INTERVAL;
        place_aliens(g);
    }
    return outcome;
}

// Channels: cannon, alien, alien that moves left, alien that moves right, bullet of the cannon,
// bullet of an alien.
HD void observe(const SpaceInvaders& g, const Env&, unsigned int* bits) {
    set_cell(bits, 0, LAST, g.x);
    for (int y = 0; y < SIDE; y++) {
        unsigned int row = (unsigned int)g.rows[y];
        set_row(bits, 1, y, row & ROW);
        set_row(bits, g.to_right ? 3 : 2, y, row & ROW);
        set_row(bits, 4, y, row >> SIDE & ROW);
        set_row(bits, 5, y, row >> 2 * SIDE & ROW);
    }
}
