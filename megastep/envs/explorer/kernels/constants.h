// Constants of Explorer that Python reads too: one per line, a plain number each.
#pragma once

constexpr int N_EPISODE = 4;  // numbers that a critic sees of an episode
