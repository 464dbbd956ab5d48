// Seaquest: a submarine shoots fish and submarines, and brings divers to the surface before its
// oxygen is used up.
//
// Things are in five lists of ints, in the order in which they came. The original removes the first
// thing that equals another from a list that it walks backwards, and so do we: see `removed`.
#pragma once
#include "board.h"

constexpr int SHOTS = 0, DIVERS = 1, BULLETS = 2, FISH = 3, SUBS = 4, N_LISTS = 5;

struct Seaquest : Game {
    int x, y, faces_right;
    int oxygen;
    int n_aboard;     // divers; below 0 after six were brought up
    int is_surfaced;  // in the last step
    int shot_timer;
    int spawn_speed, spawn_timer;
    int diver_timer;
    int move_speed;  // steps between moves of enemies
    int ramp_index;
    int n[N_LISTS];
};
static_assert(sizeof(Seaquest) == SEAQUEST_FIELDS * sizeof(int), "SEAQUEST_FIELDS");

constexpr int MAX_OXYGEN = 200, MAX_ABOARD = 6, DIVER_INTERVAL = 30, MOVE_INTERVAL = 5;
constexpr int RELOAD = 5, ENEMY_RELOAD = 10;

// A thing: 2 + x, plus 16 y; whether it moves to the right; steps until it moves and until it
// shoots. Those that leave the board have x = -1 or 10, for a moment one more.
constexpr int PLACE = 255, RIGHTWARDS = 1 << 8, TIMER = 1 << 12, RELOADING = 1 << 16;

HD int place_at(int x, int y) { return 2 + x + 16 * y; }
HD int x_of(int thing) { return (thing & 15) - 2; }
HD int y_of(int thing) { return thing >> 4 & 15; }
HD int timer_of(int thing) { return thing / TIMER & 15; }
HD int is_outside(int thing) { return x_of(thing) < 0 || x_of(thing) > LAST; }
HD int forward(int thing) { return thing + (thing & RIGHTWARDS ? 1 : -1); }

// ---- Lists ----

// At most one enemy comes per step, and crosses the board in 30 steps at the speed at which that is
// so; an enemy's bullet is gone before it shoots again. So 32 are enough, and 4 shots and divers.
HD int capacity_of(int list) { return list < BULLETS ? 4 : 32; }

HD int& at(const Env& e, int list, int i) {
    int first = list < BULLETS ? 4 * list : 8 + 32 * (list - BULLETS);
    return e.lists[(first + i) * e.n_envs + e.env];
}

HD void add(Seaquest& g, const Env& e, int list, int thing) {
    if (g.n[list] < capacity_of(list))
        at(e, list, g.n[list]++) = thing;
}

HD void remove_at(Seaquest& g, const Env& e, int list, int i) {
    g.n[list]--;
    for (; i < g.n[list]; i++)
        at(e, list, i) = at(e, list, i + 1);
}

// The first thing that agrees in the bits of a mask, or -1.
HD int find(const Seaquest& g, const Env& e, int list, int thing, int mask) {
    for (int i = 0; i < g.n[list]; i++)
        if (!((at(e, list, i) ^ thing) & mask))
            return i;
    return -1;
}

// Removes the first thing that equals the i-th. Returns where the i-th is then, or -1 if it is
// gone.
HD int removed(Seaquest& g, const Env& e, int list, int i) {
    int first = find(g, e, list, at(e, list, i), ~0);
    remove_at(g, e, list, first);
    return first == i ? -1 : i - 1;
}

// ---- Steps ----

HD void begin(Seaquest& g, const Env&) {
    g.x = 5;
    g.y = g.faces_right = 0;
    g.oxygen = MAX_OXYGEN;
    g.n_aboard = 0;
    g.is_surfaced = 1;
    g.shot_timer = 0;
    g.spawn_speed = g.spawn_timer = 20;
    g.diver_timer = DIVER_INTERVAL;
    g.move_speed = MOVE_INTERVAL;
    g.ramp_index = 0;
    for (int list = 0; list < N_LISTS; list++)
        g.n[list] = 0;
}

// Not in a row in which a fish or a submarine moves in the other direction.
HD void spawn_enemy(Seaquest& g, const Env& e) {
    int direction = draw(g, e) < HALF ? RIGHTWARDS : 0, is_sub = draw(g, e) < THIRD;
    int place = place_at(direction ? 0 : LAST, 1 + draw_below(g, e, 8));
    int row = PLACE & ~15;
    for (int list = FISH; list <= SUBS; list++)
        if (find(g, e, list, place | (direction ^ RIGHTWARDS), row | RIGHTWARDS) >= 0)
            return;
    int thing = place + direction + g.move_speed * TIMER;
    add(g, e, is_sub ? SUBS : FISH, is_sub ? thing + ENEMY_RELOAD * RELOADING : thing);
}

HD void spawn_diver(Seaquest& g, const Env& e) {
    int direction = draw(g, e) < HALF ? RIGHTWARDS : 0;
    int place = place_at(direction ? 0 : LAST, 1 + draw_below(g, e, 8));
    add(g, e, DIVERS, place + direction + MOVE_INTERVAL * TIMER);
}

HD int is_player(const Seaquest& g, int thing) { return (thing & PLACE) == place_at(g.x, g.y); }

HD void move_shots(Seaquest& g, const Env& e, Outcome& outcome) {
    for (int i = g.n[SHOTS] - 1; i >= 0; i--) {
        int shot = at(e, SHOTS, i) = forward(at(e, SHOTS, i));
        int is_gone = is_outside(shot);
        for (int list = FISH; list <= SUBS && !is_gone; list++) {
            int struck = find(g, e, list, shot, PLACE);
            if (struck < 0)
                continue;
            remove_at(g, e, list, struck);
            outcome.reward++;
            is_gone = 1;
        }
        if (is_gone)
            removed(g, e, SHOTS, i);
    }
}

HD void move_divers(Seaquest& g, const Env& e) {
    for (int i = g.n[DIVERS] - 1; i >= 0; i--) {
        int diver = at(e, DIVERS, i), has_room = g.n_aboard < MAX_ABOARD;
        int is_met = is_player(g, diver) && has_room;
        if (!is_met && timer_of(diver) == 0) {
            at(e, DIVERS, i) = diver = forward(diver) + MOVE_INTERVAL * TIMER;
            is_met = is_player(g, diver) && has_room;
        } else if (!is_met) {
            at(e, DIVERS, i) = diver - TIMER;
            continue;
        }
        g.n_aboard += is_met;
        if (is_met || is_outside(diver))
            removed(g, e, DIVERS, i);
    }
}

// Submarines shoot when they have reloaded, even if they were just struck or left the board.
HD void move_enemies(Seaquest& g, const Env& e, int list, Outcome& outcome) {
    for (int i = g.n[list] - 1; i >= 0; i--) {
        int enemy = at(e, list, i), place = i;
        outcome.is_terminal |= is_player(g, enemy);
        if (timer_of(enemy) == 0) {
            at(e, list, i) = enemy = forward(enemy) + g.move_speed * TIMER;
            int shot = find(g, e, SHOTS, enemy, PLACE);
            if (is_outside(enemy)) {
                place = removed(g, e, list, i);
            } else if (is_player(g, enemy)) {
                outcome.is_terminal = 1;
            } else if (shot >= 0) {
                place = removed(g, e, list, i);
                remove_at(g, e, SHOTS, shot);
                outcome.reward++;
            }
        } else {
            enemy -= TIMER;
        }
        if (list == SUBS && enemy / RELOADING == 0) {
            enemy += ENEMY_RELOAD * RELOADING;
            add(g, e, BULLETS, enemy & (PLACE | RIGHTWARDS));
        } else if (list == SUBS) {
            enemy -= RELOADING;
        }
        if (place >= 0)
            at(e, list, place) = enemy;
    }
}

HD void move_bullets(Seaquest& g, const Env& e, Outcome& outcome) {
    for (int i = g.n[BULLETS] - 1; i >= 0; i--) {
        int bullet = at(e, BULLETS, i);
        outcome.is_terminal |= is_player(g, bullet);
        at(e, BULLETS, i) = bullet = forward(bullet);
        if (is_outside(bullet))
            removed(g, e, BULLETS, i);
        else
            outcome.is_terminal |= is_player(g, bullet);
    }
}

// Six divers earn the oxygen that is left, and are one more than are counted off then.
HD int surface(Seaquest& g, const Env& e) {
    int reward = 0;
    g.is_surfaced = 1;
    if (g.n_aboard == MAX_ABOARD) {
        g.n_aboard = 0;
        reward = g.oxygen * 10 / MAX_OXYGEN;
    }
    g.oxygen = MAX_OXYGEN;
    g.n_aboard--;
    if (e.is_ramping && (g.spawn_speed > 1 || g.move_speed > 2)) {
        g.move_speed -= g.move_speed > 2 && g.ramp_index & 1;
        g.spawn_speed -= g.spawn_speed > 1;
        g.ramp_index++;
    }
    return reward;
}

HD Outcome play(Seaquest& g, const Env& e, int action) {
    Outcome outcome = {0, 0};
    for (int list = 0; list < N_LISTS; list++)  // whatever was written into a game
        g.n[list] = within(g.n[list], capacity_of(list));
    if (g.spawn_timer == 0) {
        spawn_enemy(g, e);
        g.spawn_timer = g.spawn_speed;
    }
    if (g.diver_timer == 0) {
        spawn_diver(g, e);
        g.diver_timer = DIVER_INTERVAL;
    }
    if (action == FIRE && g.shot_timer == 0) {
        add(g, e, SHOTS, place_at(g.x, g.y) + (g.faces_right ? RIGHTWARDS : 0));
        g.shot_timer = RELOAD;
    }
    g.x = moved(g.x, action, LEFT, RIGHT, 0, LAST);
    g.y = moved(g.y, action, UP, DOWN, 0, LAST - 1);
    if (action == LEFT || action == RIGHT)
        g.faces_right = action == RIGHT;
    move_shots(g, e, outcome);
    move_divers(g, e);
    move_enemies(g, e, SUBS, outcome);
    move_bullets(g, e, outcome);
    move_enemies(g, e, FISH, outcome);
    g.spawn_timer -= g.spawn_timer > 0;
    g.diver_timer -= g.diver_timer > 0;
    g.shot_timer -= g.shot_timer > 0;
    outcome.is_terminal |= g.oxygen <= 0;
    if (g.y > 0) {
        g.oxygen--;
        g.is_surfaced = 0;
    } else if (!g.is_surfaced && g.n_aboard == 0) {
        outcome.is_terminal = 1;
    } else if (!g.is_surfaced) {
        outcome.reward += surface(g, e);
    }
    return outcome;
}

// Channels: front and back of the submarine, shot, trail, bullet, fish, enemy submarine, oxygen,
// divers on board, diver.
HD void observe(const Seaquest& g, const Env& e, unsigned int* bits) {
    const int channels[N_LISTS] = {2, 9, 4, 5, 6};
    set_cell(bits, 0, g.y, g.x);
    set_cell(bits, 1, g.y, g.faces_right ? g.x - 1 : g.x + 1);
    for (int x = 0; x < within(g.oxygen, MAX_OXYGEN) * 10 / MAX_OXYGEN; x++)
        set_cell(bits, 7, LAST, x);
    for (int x = LAST - within(g.n_aboard, MAX_ABOARD); x < LAST; x++)
        set_cell(bits, 8, LAST, x);
    for (int list = 0; list < N_LISTS; list++)
        for (int i = 0; i < g.n[list]; i++) {
            int thing = at(e, list, i);
            set_cell(bits, channels[list], y_of(thing), x_of(thing));
            if (list != SHOTS && list != BULLETS)
                set_trail(bits, 3, y_of(thing), x_of(thing), thing & RIGHTWARDS);
        }
}
