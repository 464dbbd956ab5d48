// The state of MiniGrid's games, and how random numbers are drawn.
#pragma once
#include "common/philox.h"
#include "common/step.h"

constexpr int VIEW = 7;          // cells along a side of the agent's view
constexpr int GAME_FIELDS = 19;  // of struct Game
constexpr int MAX_OBSTACLES = 8;
constexpr int MAX_ROOMS = 9;
constexpr int N_MISSION = 18;  // numbers of a mission: colour, kind; colour, kind

// What a cell holds is a kind, plus 16 times a colour. The first nine have the numbers of the
// original's encoding; a door has one for each of its states.
constexpr int EMPTY = 1;
constexpr int WALL = 2;
constexpr int OPEN_DOOR = 4;
constexpr int KEY = 5;
constexpr int BALL = 6;
constexpr int BOX = 7;
constexpr int GOAL = 8;
constexpr int LAVA = 9;
constexpr int CLOSED_DOOR = 10;
constexpr int LOCKED_DOOR = 11;

// Tasks.
constexpr int EMPTY_ROOM = 0;
constexpr int FOUR_ROOMS = 1;
constexpr int DOOR_KEY = 2;
constexpr int UNLOCK = 3;
constexpr int UNLOCK_PICKUP = 4;
constexpr int KEY_CORRIDOR = 5;
constexpr int MULTI_ROOM = 6;
constexpr int LAVA_GAP = 7;
constexpr int CROSSING = 8;
constexpr int DIST_SHIFT = 9;
constexpr int MEMORY = 10;
constexpr int RED_BLUE_DOORS = 11;
constexpr int DYNAMIC_OBSTACLES = 12;
constexpr int PUT_NEAR = 13;
constexpr int GO_TO_DOOR = 14;
constexpr int CUSTOM = 15;

// N games of W x H cells.
struct MiniGridStepParams : BoardParams {
    unsigned char* cells;          // (N, H, W) in and out
    unsigned char* image;          // (N, 3, VIEW, VIEW) out, as the next two
    long long* direction;          // (N) 0 right, 1 down, 2 left, 3 up
    float* mission;                // (N, N_MISSION), or null
    const unsigned char* layouts;  // (D, H, W) for CUSTOM, or null
    const int* starts;             // (D, 3): x, y and direction of the agent
    int width;                     // W
    int height;                    // H
    int task;                      // see above
    int a;                         // of the task: see layouts.h; D
    int b;                         // of the task
    int c;                         // of the task
    int n_actions;                 // those above are errors
    int sees_through;              // whether the agent sees through walls
};

constexpr int TURN_LEFT = 0, TURN_RIGHT = 1, FORWARD = 2, PICK_UP = 3, DROP = 4, TOGGLE = 5,
              DONE = 6;
constexpr int RED = 0, GREEN = 1, BLUE = 2, PURPLE = 3, YELLOW = 4, GREY = 5, N_COLOURS = 6;
constexpr int BALL_BLUE = BALL + 16 * BLUE;
// Draws of a layout, after which it is given up as it is. Among 20,000 layouts of each task none
// needs more than 2,300.
constexpr int MAX_DRAWS = 50000;
constexpr int MAX_TRIES = MAX_DRAWS;

struct Game {
    int x, y, direction;
    int carried;  // a cell; 0: nothing
    int age;      // steps of the episode
    int n_draws;  // numbers drawn so far, the generator's counter
    int ended;
    int marks[2];                  // what the task's success depends on: cells or their contents
    int mission[2];                // contents that the mission names; 0: none
    int obstacles[MAX_OBSTACLES];  // their cells
};
static_assert(sizeof(Game) == GAME_FIELDS * sizeof(int), "GAME_FIELDS");

// What the layout and the steps of a game need: values, so that no function takes the address of
// the parameters, which a GPU would copy first.
struct Grid {
    unsigned char* cells;  // (H, W)
    int width, height, env, task, a, b, c, sees_through;
    int first_draw;  // of this step
    unsigned int key0, key1;
    const unsigned char* layouts;
    const int* starts;
    int* error_flag;
};

HD Grid grid_of(const MiniGridStepParams& p, const Game& g, int env) {
    unsigned char* cells = p.cells + (long long)env * p.width * p.height;
    return {cells,          p.width,   p.height, env,    p.task,    p.a,      p.b,         p.c,
            p.sees_through, g.n_draws, p.key0,   p.key1, p.layouts, p.starts, p.error_flag};
}

// Cells x to x + width - 1 and y to y + height - 1.
struct Rectangle {
    int x, y, width, height;
};

HD int absi(int x) { return x < 0 ? -x : x; }
HD int cell_of(int kind, int colour) { return kind + 16 * colour; }
HD int kind_of(int cell) { return cell & 15; }
HD int colour_of(int cell) { return cell >> 4; }
HD int at(const Grid& grid, int x, int y) { return y * grid.width + x; }
HD int dx_of(int direction) { return direction == 0 ? 1 : direction == 2 ? -1 : 0; }
HD int dy_of(int direction) { return direction == 1 ? 1 : direction == 3 ? -1 : 0; }

// The cell itself, or the first one if it is not in the grid, whatever was written into a game.
HD int inside(const Grid& grid, int cell) {
    return (unsigned int)cell < (unsigned int)(grid.width * grid.height) ? cell : 0;
}

// Agents stand inside of walls, so the cell in front of one is in the grid.
HD int front_of(const Game& g, const Grid& grid) {
    return inside(grid, at(grid, g.x + dx_of(g.direction), g.y + dy_of(g.direction)));
}

HD int is_beside(const Grid& grid, int a, int b) {
    return absi(a % grid.width - b % grid.width) + absi(a / grid.width - b / grid.width) == 1;
}

// Whether there are draws left in this step. Flags an error if not.
RARE int may_draw(const Game& g, const Grid& grid) {
    if ((unsigned int)g.n_draws - (unsigned int)grid.first_draw < (unsigned int)MAX_DRAWS)
        return 1;
    flag_error(grid.error_flag, grid.env, NO_LAYOUT);
    return 0;
}

// A random integer in [low, high).
RARE int draw(Game& g, const Grid& grid, int low, int high) {
    unsigned int word = random_word(grid.env, g.n_draws++, grid.key0, grid.key1);
    return low + (int)((unsigned long long)word * (unsigned int)(high - low) >> 32);
}

// Draws places in a rectangle until one holds nothing, is not the agent's, and is not rejected.
// Puts a cell's contents there. Returns the place, or -1 after so many tries.
template <class IsRejected>
HD int place_unless(Game& g, const Grid& grid, int cell, Rectangle in, int n_tries,
                    IsRejected is_rejected) {
    int left = maxi(in.x, 0), top = maxi(in.y, 0);
    int right = mini(left + in.width, grid.width), bottom = mini(top + in.height, grid.height);
    for (int i = 0; i < n_tries && may_draw(g, grid); i++) {
        int x = draw(g, grid, left, right), y = draw(g, grid, top, bottom);
        int place = at(grid, x, y);
        if (grid.cells[place] != EMPTY || (x == g.x && y == g.y) || is_rejected(x, y))
            continue;
        grid.cells[place] = (unsigned char)cell;
        return place;
    }
    return -1;
}

RARE int place(Game& g, const Grid& grid, int cell, Rectangle in, int n_tries = MAX_TRIES) {
    return place_unless(g, grid, cell, in, n_tries, [](int, int) { return 0; });
}
