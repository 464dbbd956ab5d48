// MinAtar (Young and Tian 2019): five games, step by step as minatar 1.0.15 plays them, with its
// random numbers drawn in the same order.
#pragma once
#include "asterix.h"
#include "breakout.h"
#include "freeway.h"
#include "seaquest.h"
#include "space_invaders.h"

// One step of a game, with the bits of its observation. Games that have ended begin anew.
template <class Kind>
HD void step_game(const MinAtarStepParams& p, int env, unsigned int* bits) {
    Kind g;
    load_game(g, p.games, p.n_envs, env);
    Env e = {p.lists, p.n_envs, env, p.is_ramping, p.key0, p.key1};
    Outcome outcome = {0, 0};
    int is_reset = g.ended != 0;
    if (is_reset) {
        begin(g, e);
        g.age = g.ended = 0;
    } else {
        long long action = p.actions[env];
        int is_known = action >= 0 && action < p.n_actions;
        if (!is_known)
            flag_error(p.error_flag, env, BAD_ACTION);
        int is_repeated = draw(g, e) < p.sticky;
        if (!is_repeated)
            g.last_action = is_known ? p.action_set >> 4 * (int)action & 15 : 0;
        outcome = play(g, e, g.last_action);
        g.age++;
        g.ended = outcome.is_terminal || g.age >= p.limit;
    }
    store_game(g, p.games, p.n_envs, env);
    write_outcome(p, env, (float)outcome.reward, is_reset, g.ended, outcome.is_terminal);
    for (int i = 0; i < WORDS; i++)
        bits[i] = 0;
    observe(g, e, bits);
}

HD void minatar_env(const MinAtarStepParams& p, int env, unsigned int* bits) {
    switch (p.game) {
        case BREAKOUT:
            return step_game<Breakout>(p, env, bits);
        case ASTERIX:
            return step_game<Asterix>(p, env, bits);
        case FREEWAY:
            return step_game<Freeway>(p, env, bits);
        case SEAQUEST:
            return step_game<Seaquest>(p, env, bits);
        default:
            return step_game<SpaceInvaders>(p, env, bits);
    }
}
