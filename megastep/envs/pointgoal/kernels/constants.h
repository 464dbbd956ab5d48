// Constants of PointGoal that Python reads too: one per line, a plain number each.
#pragma once

// Rows of `progress`, which describes an agent's episode so far.
constexpr int PREVIOUS_X = 0;  // position one step ago, in metres
constexpr int PREVIOUS_Y = 1;
constexpr int DISTANCE = 2;        // to the goal by the shortest path, from the goal's field
constexpr int START_DISTANCE = 3;  // the same at the start of the episode
constexpr int SHORTEST = 4;        // exact length of the shortest path from the start
constexpr int WALKED = 5;          // metres walked since the start
constexpr int COLLISIONS = 6;      // since the start
constexpr int PROGRESS_ROWS = 7;

constexpr int N_PRIVILEGED = 4;  // numbers that a critic sees
