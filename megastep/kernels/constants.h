// Constants of the engine that Python reads too: one per line, a plain number each.
#pragma once

constexpr int MAX_RES = 1024;          // rays per camera: 32 tiles of 32 pixels
constexpr int MAX_SUBSAMPLE = 32;      // rays per pixel: at most one warp
constexpr int NEAREST_LINE_BYTES = 8;  // of shared memory per ray, while rendering
constexpr int BANDS = 3;               // of distance, for unseen: up to 1.5 m, up to 4 m, beyond
constexpr int SECTORS = 16;            // of bearing, for unseen
