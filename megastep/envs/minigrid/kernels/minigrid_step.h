// MiniGrid (Chevalier-Boisvert et al. 2023): the steps and the observations of all its tasks. Cells
// are bytes, and random numbers are drawn in the order of minigrid 3.2.
#pragma once
#include "layouts.h"

HD void turn(Game& g, int by) { g.direction = (g.direction + by) & 3; }

// What toggling does to a cell: a box vanishes, and a locked door needs the key of its colour.
HD int toggled(int cell, int carried) {
    int colour = colour_of(cell);
    switch (kind_of(cell)) {
        case BOX:
            return EMPTY;
        case OPEN_DOOR:
            return cell_of(CLOSED_DOOR, colour);
        case CLOSED_DOOR:
            return cell_of(OPEN_DOOR, colour);
        case LOCKED_DOOR:
            return carried == cell_of(KEY, colour) ? cell_of(OPEN_DOOR, colour) : cell;
        default:
            return cell;
    }
}

HD int can_be_picked_up(int cell) { return kind_of(cell) >= KEY && kind_of(cell) <= BOX; }

HD int can_be_entered(int cell) {
    int kind = kind_of(cell);
    return kind == EMPTY || kind == OPEN_DOOR || kind == GOAL || kind == LAVA;
}

// Each obstacle goes to a random free cell around it, if 101 draws find one.
RARE void move_obstacles(Game& g, const Grid& grid) {
    for (int i = 0; i < grid.b; i++) {
        int old = inside(grid, g.obstacles[i]), x = old % grid.width, y = old / grid.width;
        int found = place(g, grid, BALL_BLUE, {x - 1, y - 1, 3, 3}, 101);
        if (found < 0)
            continue;
        g.obstacles[i] = found;
        grid.cells[old] = EMPTY;
    }
}

struct Outcome {
    int is_terminal, is_success, is_failure;  // failure: a reward of -1
};

// What all tasks share: the agent's action on the cell in front of it.
HD Outcome act(Game& g, const Grid& grid, int action) {
    Outcome outcome = {0, 0, 0};
    int front = front_of(g, grid), cell = grid.cells[front];
    switch (action) {
        case TURN_LEFT:
            turn(g, 3);
            break;
        case TURN_RIGHT:
            turn(g, 1);
            break;
        case FORWARD:
            if (can_be_entered(cell)) {
                g.x = front % grid.width;
                g.y = front / grid.width;
            }
            outcome.is_success = kind_of(cell) == GOAL;
            outcome.is_terminal = outcome.is_success || kind_of(cell) == LAVA;
            break;
        case PICK_UP:
            if (can_be_picked_up(cell) && !g.carried) {
                g.carried = cell;
                grid.cells[front] = EMPTY;
            }
            break;
        case DROP:
            if (cell == EMPTY && g.carried) {
                grid.cells[front] = (unsigned char)g.carried;
                g.carried = 0;
            }
            break;
        case TOGGLE:
            grid.cells[front] = (unsigned char)toggled(cell, g.carried);
    }
    return outcome;
}

HD int is_open(const Grid& grid, int at) {
    return kind_of(grid.cells[inside(grid, at)]) == OPEN_DOOR;
}

HD int distance(const Grid& grid, int a, int b) {
    return maxi(absi(a % grid.width - b % grid.width), absi(a / grid.width - b / grid.width));
}

// One step of a task, with what it adds to the agent's action.
HD Outcome play(Game& g, const Grid& grid, int action) {
    int task = grid.task, marks[2] = {g.marks[0], g.marks[1]};
    if (task == DYNAMIC_OBSTACLES) {
        int front = kind_of(grid.cells[front_of(g, grid)]);
        int is_blocked = front != EMPTY && front != GOAL;
        Game moved = g;  // as in minigrid_env
        move_obstacles(moved, grid);
        g = moved;
        Outcome outcome = act(g, grid, action);
        if (action == FORWARD && is_blocked)
            outcome = {1, 0, 1};
        return outcome;
    }
    if (task == MEMORY && action == PICK_UP)
        action = TOGGLE;
    int was_red_open = task == RED_BLUE_DOORS && is_open(grid, marks[0]);
    int was_blue_open = task == RED_BLUE_DOORS && is_open(grid, marks[1]);
    int had = g.carried;
    Outcome outcome = act(g, grid, action);
    int here = at(grid, g.x, g.y), front = front_of(g, grid);
    if (task == UNLOCK && action == TOGGLE && is_open(grid, marks[0]))
        return {1, 1, 0};
    if ((task == UNLOCK_PICKUP || task == KEY_CORRIDOR) && action == PICK_UP &&
        g.carried == marks[0])
        return {1, 1, 0};
    if (task == MEMORY && (here == marks[0] || here == marks[1]))
        return {1, here == marks[0], 0};
    if (task == RED_BLUE_DOORS) {
        if (is_open(grid, marks[1]))
            return {1, was_red_open, 0};
        if (is_open(grid, marks[0]) && was_blue_open)
            return {1, 0, 0};
    }
    if (task == PUT_NEAR && action == PICK_UP && g.carried && g.carried != marks[0])
        outcome.is_terminal = 1;
    if (task == PUT_NEAR && action == DROP && had)
        return {1, !g.carried && distance(grid, front, marks[1]) <= 1, 0};
    if (task == GO_TO_DOOR && action == TOGGLE)
        outcome.is_terminal = 1;
    if (task == GO_TO_DOOR && action == DONE)
        return {1, is_beside(grid, here, marks[0]), 0};
    return outcome;
}

// ---- Observations ----

// The cells that the agent sees, one bit each: row j of the view in bits VIEW j to VIEW j + 6. A
// row of cells that one can look through passes what is seen along it and to the row before it:
// first to the right and then to the left, as the original does.
HD unsigned long long visible_cells(unsigned long long clear) {
    const unsigned int row_mask = (1u << VIEW) - 1u;
    unsigned long long seen = 0;
    unsigned int row = 1u << VIEW / 2;  // the agent, in the middle of the last row
    for (int j = VIEW - 1; j >= 0; j--) {
        unsigned int through = (unsigned int)(clear >> VIEW * j) & row_mask, before = 0;
        for (int i = 0; i < VIEW - 1; i++)
            if (row & through & 1u << i) {
                row |= 2u << i;
                before |= 3u << i;
            }
        for (int i = VIEW - 1; i > 0; i--)
            if (row & through & 1u << i) {
                row |= 1u << (i - 1);
                before |= 3u << (i - 1);
            }
        seen |= (unsigned long long)row << VIEW * j;
        row = before;
    }
    return seen;
}

// Writes the agent's view, (3, VIEW, VIEW): kinds, colours and states, 0 where it does not see. The
// agent is in the middle of the last row, where it sees what it carries.
HD void write_view(const Game& g, const Grid& grid, unsigned char* image) {
    constexpr int SIZE = VIEW * VIEW;
    int dx = dx_of(g.direction), dy = dy_of(g.direction);
    unsigned long long clear = 0;
    for (int k = 0; k < SIZE; k++) {
        int ahead = VIEW - 1 - k / VIEW, right = k % VIEW - VIEW / 2;
        int x = g.x + dx * ahead - dy * right, y = g.y + dy * ahead + dx * right;
        int is_inside = x >= 0 && y >= 0 && x < grid.width && y < grid.height;
        int cell = is_inside ? grid.cells[at(grid, x, y)] : cell_of(WALL, GREY);
        int kind = kind_of(cell);
        clear |= (unsigned long long)(kind != WALL && kind < CLOSED_DOOR) << k;
        if (k == SIZE - 1 - VIEW / 2)
            cell = g.carried ? g.carried : EMPTY, kind = kind_of(cell);
        image[k] = (unsigned char)(kind < CLOSED_DOOR ? kind : OPEN_DOOR);
        image[SIZE + k] = (unsigned char)colour_of(cell);
        image[2 * SIZE + k] = (unsigned char)(kind < CLOSED_DOOR ? 0 : kind - CLOSED_DOOR + 1);
    }
    unsigned long long seen = grid.sees_through ? ~0ull : visible_cells(clear);
    for (int k = 0; k < SIZE; k++)
        if (!(seen >> k & 1))
            image[k] = image[SIZE + k] = image[2 * SIZE + k] = 0;
}

// One-hot: a colour and a kind (key, ball, box), of what to move and of where to.
HD void write_mission(const Game& g, float* mission) {
    for (int i = 0; i < N_MISSION; i++) {
        int cell = g.mission[i / 9], k = i % 9;
        int is_set = cell && (k < 6 ? colour_of(cell) == k : kind_of(cell) - KEY == k - 6);
        mission[i] = (float)is_set;
    }
}

// One step of an environment, with its observation. Games that have ended begin anew.
HD void minigrid_env(const MiniGridStepParams& p, int env, unsigned char* image) {
    Game g;
    load_game(g, p.games, p.n_envs, env);
    Grid grid = grid_of(p, g, env);
    Outcome outcome = {0, 0, 0};
    int is_reset = g.ended != 0;
    if (is_reset) {
        Game fresh = g;  // whose address is taken, so that g can stay in registers
        new_game(fresh, grid);
        g = fresh;
    } else {
        long long action = p.actions[env];
        int is_known = action >= 0 && action < p.n_actions;
        if (!is_known)
            flag_error(p.error_flag, env, BAD_ACTION);
        g.age++;
        outcome = play(g, grid, is_known ? (int)action : DONE);
        g.ended = outcome.is_terminal || g.age >= p.limit;
    }
    store_game(g, p.games, p.n_envs, env);
    double reward = outcome.is_success ? 1.0 - 0.9 * ((double)g.age / (double)p.limit) : 0.0;
    write_outcome(p, env, outcome.is_failure ? -1.f : (float)reward, is_reset, g.ended,
                  outcome.is_terminal);
    p.metrics[env] = (float)outcome.is_success;
    p.direction[env] = g.direction;
    write_view(g, grid, image);
    if (p.mission)
        write_mission(g, p.mission + (long long)N_MISSION * env);
}
