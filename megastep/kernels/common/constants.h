// Constants that all kernel libraries share. Python reads this file too: one constant per line,
// a plain number each.
#pragma once

constexpr int BLOCK = 64;      // threads per block, in every launch
constexpr int WARP = 32;       // threads per warp
constexpr int BOX_WALLS = 32;  // walls of a layout that share a bounding box, one per warp lane

// Errors that only the device can see. A flag holds ERROR_KINDS * env + kind; 0 means no error.
constexpr int ERROR_KINDS = 8;
constexpr int NONFINITE = 1;   // a position, angle or velocity is NaN or infinite
constexpr int BAD_ACTION = 2;  // an action outside of the action space
constexpr int BAD_LAYOUT = 3;  // a layout that the scenery does not have
constexpr int BAD_GOAL = 4;    // a goal or a spawn point that the layout does not have
constexpr int NAN_ACTION = 5;  // a continuous action that is NaN
