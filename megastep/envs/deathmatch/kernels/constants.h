// Constants of Deathmatch that Python reads too: one per line, a plain number each.
#pragma once

constexpr int MAX_AGENTS = 16;              // per environment
constexpr int TALLY_ROWS = 3;               // of an episode so far: kills, damage, hits
constexpr int PRIVILEGED_PER_OPPONENT = 5;  // numbers that a critic sees of each other agent
