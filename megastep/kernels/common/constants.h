// Constants that all kernel libraries share. Python reads this file too: one constant per line,
// a plain number each.
#pragma once

constexpr int BLOCK = 64;      // threads per block, in every launch
constexpr int WARP = 32;       // threads per warp
constexpr int COPY_WORDS = 4;  // words of 16 bytes that a thread copies
constexpr int BOX_WALLS = 32;  // walls of a layout that share a bounding box, one per warp lane

// Errors that only the device can see. A flag holds ERROR_KINDS * index + kind; 0 means no error.
// The index is an environment's or, of the last five, an object's among those of all environments.
constexpr int ERROR_KINDS = 16;
constexpr int NONFINITE = 1;    // a position, angle or velocity is NaN or infinite
constexpr int BAD_ACTION = 2;   // an action outside of the action space
constexpr int BAD_LAYOUT = 3;   // a layout that the scenery does not have
constexpr int BAD_GOAL = 4;     // a goal or a spawn point that the layout does not have
constexpr int NAN_ACTION = 5;   // a continuous action that is NaN
constexpr int NO_LAYOUT = 6;    // a grid that many draws did not make
constexpr int BAD_POSE = 6;     // a pose that is not finite, or a size that is not above 0
constexpr int BAD_COLOUR = 7;   // a colour that the palette does not have
constexpr int BAD_CARRIER = 8;  // a carrier that is no agent
constexpr int OUTSIDE = 9;      // a position outside of the home
constexpr int NO_ROOM = 10;     // nowhere to put it

// Shapes of objects: a hexagon in a disc, a square, a segment, a square without its low side.
constexpr int DISC = 0;
constexpr int CRATE = 1;
constexpr int DOOR = 2;
constexpr int RAMP = 3;
constexpr int OBJECT_BYTES = 32;  // of a record
constexpr int BODY_BYTES = 48;
constexpr int MAX_BODIES = 16;  // objects of an environment that can be pushed
constexpr int MAX_SLOTS = 32;   // with its agents
