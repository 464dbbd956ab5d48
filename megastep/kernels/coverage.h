// Coverage: the fraction of the visible texels that an agent has seen.
#pragma once
#include "common/scenery.h"
#include "params.h"

// Counts, of a word's 32 texels, the visible ones and those of them that were seen.
HD void count_covered(unsigned int seen, unsigned int visible, int& n_seen, int& n_visible) {
    n_seen += COUNT_BITS(seen & visible);
    n_visible += COUNT_BITS(visible);
}

HD float fraction_of(int n_seen, int n_visible) {
    return (float)n_seen / (float)maxi(n_visible, 1);
}
