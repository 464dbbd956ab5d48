// Constants that Python reads too: one per line, a plain number each.
#pragma once

constexpr int GROUP = 8;       // walls that share a bounding box in searches for shortest paths
constexpr int KEPT = 16;       // links of a corner that need not be searched for twice
constexpr int MAX_GOALS = 16;  // per home, in one search
