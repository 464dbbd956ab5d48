// Constants of Explorer that Python reads too: one per line, a plain number each.
#pragma once

constexpr int BANDS = 3;      // of distance: up to 1.5 m, up to 4 m, beyond
constexpr int SECTORS = 16;   // of bearing
constexpr int N_EPISODE = 4;  // numbers that a critic sees of an episode
