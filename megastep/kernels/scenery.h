// Where a layout's walls and boxes lie.
#pragma once
#include "backend.h"
#include "params.h"

struct Walls {
    int first_wall, end_wall, first_box, end_box;
};

HD Walls walls_of(const SceneryParams& s, int layout) {
    return {s.wall_starts[layout], s.wall_starts[layout + 1], s.box_starts[layout],
            s.box_starts[layout + 1]};
}
