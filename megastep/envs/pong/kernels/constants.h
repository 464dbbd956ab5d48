// Constants of Pong that Python reads too: one per line, a plain number each.
#pragma once

constexpr int ROWS = 30;     // of the court, in cells; a cell is one pixel
constexpr int COLUMNS = 40;  // of the court, in cells
constexpr int CELL = 256;    // units per cell: positions and speeds are integers
constexpr int PADDLE_ROWS = 4;
constexpr int BALL_GREY = 255;
constexpr int PADDLE_GREY = 170;
constexpr int TRAIL_GREY = 85;   // where the ball was one step ago
constexpr int GAME_FIELDS = 13;  // of struct Game
constexpr int N_FEATURES = 8;    // of an observation
