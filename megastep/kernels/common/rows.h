// Launches that handle many tensors, a row of parameters each.
#pragma once
#include "common/dependent_launch.h"

// Calls f with a word of so many bytes, 1, 2, 4, 8 or 16.
template <class F>
DEVICE void with_word(int n_bytes, F f) {
    if (n_bytes == 16)
        f(uint4());
    else if (n_bytes == 8)
        f(uint2());
    else if (n_bytes == 4)
        f((unsigned int)0);
    else if (n_bytes == 2)
        f((unsigned short)0);
    else
        f((unsigned char)0);
}

// The last row that begins at or before this block.
template <class Row>
DEVICE int row_of_block(const Row* rows, int n_rows) {
    int row = 0, end = n_rows;
    while (end - row > 1) {
        int middle = (row + end) / 2;
        (rows[middle].first_block <= blockIdx.x ? row : end) = middle;
    }
    return row;
}
