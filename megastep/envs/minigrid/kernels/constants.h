// Constants of MiniGrid that Python reads too: one per line, a plain number each.
#pragma once

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
