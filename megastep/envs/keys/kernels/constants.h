// Constants of Keys that Python reads too: one per line, a plain number each.
#pragma once

constexpr int OPEN = -1;      // the state of a doorway without a door
constexpr int N_METRICS = 3;  // success, doors opened, keys wasted
