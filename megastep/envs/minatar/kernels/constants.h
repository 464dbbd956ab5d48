// Constants of MinAtar that Python reads too: one per line, a plain number each.
#pragma once

constexpr int SIDE = 10;  // cells along a side of the board

// Rows of every game's state.
constexpr int AGE = 0;
constexpr int N_DRAWS = 1;
constexpr int ENDED = 2;
constexpr int LAST_ACTION = 3;

// Games, the numbers of their states, and the channels of their observations.
constexpr int BREAKOUT = 0;
constexpr int BREAKOUT_FIELDS = 12;
constexpr int BREAKOUT_CHANNELS = 4;
constexpr int ASTERIX = 1;
constexpr int ASTERIX_FIELDS = 20;
constexpr int ASTERIX_CHANNELS = 4;
constexpr int FREEWAY = 2;
constexpr int FREEWAY_FIELDS = 15;
constexpr int FREEWAY_CHANNELS = 7;
constexpr int SEAQUEST = 3;
constexpr int SEAQUEST_FIELDS = 21;
constexpr int SEAQUEST_CHANNELS = 10;
constexpr int SPACE_INVADERS = 4;
constexpr int SPACE_INVADERS_FIELDS = 20;
constexpr int SPACE_INVADERS_CHANNELS = 6;

constexpr int LIST_FIELDS = 104;     // of Seaquest's lists: see seaquest.h
constexpr int FREEWAY_STEPS = 2501;  // of an episode of Freeway, which ends by itself
