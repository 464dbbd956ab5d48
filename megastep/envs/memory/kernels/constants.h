// Constants of Memory that Python reads too: one per line, a plain number each.
#pragma once

constexpr int N_GOAL = 4;  // numbers that a critic sees of the object to find
