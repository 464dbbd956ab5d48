// Asterix: a player dodges enemies and collects gold, both of which cross the board along rows.
#pragma once
#include "board.h"

constexpr int LINES = 8;  // rows 1 to 8

struct Asterix : Game {
    int x, y;
    int spawn_speed, spawn_timer;
    int move_speed, move_timer;
    int ramp_timer, ramp_index;
    int things[LINES];  // by row: x, plus TO_RIGHT, plus GOLD; NOTHING
};
static_assert(sizeof(Asterix) == ASTERIX_FIELDS * sizeof(int), "ASTERIX_FIELDS");

constexpr int TO_RIGHT = 16, GOLD = 32, NOTHING = -1, RAMP_INTERVAL = 100;

HD void begin(Asterix& g, const Env&) {
    g.x = g.y = 5;
    g.spawn_speed = g.spawn_timer = 10;
    g.move_speed = g.move_timer = 5;
    g.ramp_timer = RAMP_INTERVAL;
    g.ramp_index = 0;
    for (int i = 0; i < LINES; i++)
        g.things[i] = NOTHING;
}

// In a random row that is free, if there is one.
HD void spawn(Asterix& g, const Env& e) {
    int is_right = draw(g, e) < HALF, is_gold = draw(g, e) < THIRD, n_free = 0;
    for (int i = 0; i < LINES; i++)
        n_free += g.things[i] == NOTHING;
    if (!n_free)
        return;
    int chosen = draw_below(g, e, n_free);
    for (int i = 0; i < LINES; i++)
        if (g.things[i] == NOTHING && chosen-- == 0)
            g.things[i] = (is_right ? TO_RIGHT : LAST) + (is_gold ? GOLD : 0);
}

HD void touch(Asterix& g, Outcome& outcome, int i) {
    int thing = g.things[i];
    if (thing == NOTHING || (thing & 15) != g.x || i + 1 != g.y)
        return;
    if (thing & GOLD) {
        g.things[i] = NOTHING;
        outcome.reward++;
    } else {
        outcome.is_terminal = 1;
    }
}

HD Outcome play(Asterix& g, const Env& e, int action) {
    Outcome outcome = {0, 0};
    if (g.spawn_timer == 0) {
        spawn(g, e);
        g.spawn_timer = g.spawn_speed;
    }
    g.x = moved(g.x, action, LEFT, RIGHT, 0, LAST);
    g.y = moved(g.y, action, UP, DOWN, 1, LINES);
    for (int i = 0; i < LINES; i++)
        touch(g, outcome, i);
    if (g.move_timer == 0) {
        g.move_timer = g.move_speed;
        for (int i = 0; i < LINES; i++) {
            int thing = g.things[i];
            if (thing == NOTHING)
                continue;
            int x = (thing & 15) + (thing & TO_RIGHT ? 1 : -1);
            g.things[i] = x < 0 || x > LAST ? NOTHING : (thing & ~15) + x;
            touch(g, outcome, i);
        }
    }
    g.spawn_timer--;
    g.move_timer--;
    if (!e.is_ramping || (g.spawn_speed <= 1 && g.move_speed <= 1))
        return outcome;
    if (g.ramp_timer-- >= 0)
        return outcome;
    if (g.move_speed > 1 && g.ramp_index & 1)
        g.move_speed--;
    if (g.spawn_speed > 1)
        g.spawn_speed--;
    g.ramp_index++;
    g.ramp_timer = RAMP_INTERVAL;
    return outcome;
}

// Channels: player, enemy, trail, gold.
HD void observe(const Asterix& g, const Env&, unsigned int* bits) {
    set_cell(bits, 0, g.y, g.x);
    for (int i = 0; i < LINES; i++) {
        int thing = g.things[i], x = thing & 15;
        if (thing == NOTHING)
            continue;
        set_cell(bits, thing & GOLD ? 3 : 1, i + 1, x);
        set_trail(bits, 2, i + 1, x, thing & TO_RIGHT);
    }
}
