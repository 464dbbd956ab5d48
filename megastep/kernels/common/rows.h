// Launches that handle many tensors, a row of parameters each.
#pragma once
#include "common/dependent_launch.h"

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
