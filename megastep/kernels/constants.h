// Constants of the engine that Python reads too: one per line, a plain number each.
#pragma once

constexpr int MAX_RES = 1024;          // rays per camera: 32 tiles of 32 pixels
constexpr int MAX_SUBSAMPLE = 32;      // rays per pixel: at most one warp
constexpr int NEAREST_LINE_BYTES = 8;  // of shared memory per ray, while rendering
