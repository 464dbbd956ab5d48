// What share of the texels that an agent could see it has seen.
#pragma once
#include "errors.h"

// The 32 texels of a word: how many can be seen, and how many of those were.
HD void count_covered(unsigned int seen, unsigned int visible, int& n_seen, int& n_visible) {
    n_seen += COUNT_BITS(seen & visible);
    n_visible += COUNT_BITS(visible);
}

HD float share_of(int n_seen, int n_visible) { return (float)n_seen / (float)maxi(n_visible, 1); }
