// Constants of Deathmatch that Python reads too: one per line, a plain number each.
#pragma once

constexpr int MAX_AGENTS = 16;              // per environment
constexpr int SUMS = 3;                     // of an episode so far: kills, damage, hits
constexpr int TALLY_ROWS = 4;               // these, and how well the agent aimed last
constexpr int PRIVILEGED_PER_OPPONENT = 5;  // numbers that a critic sees of each other agent

// The bot.
constexpr int NOTHING = 0;  // actions with momentum
constexpr int FORWARD = 3;
constexpr int LEFT = 5;
constexpr int RIGHT = 6;
constexpr float TURN = 18.0f;       // degrees per second added by an action
constexpr float RETAINED = 0.875f;  // fraction of a velocity left after a step
constexpr float STEP = 0.1f;        // seconds
constexpr float SATURATED = 0.12f;  // part of light in the weakest channel: agents less, walls more
constexpr float DARK = 0.01f;       // darker pixels are ignored
constexpr int LOOK = 25;            // steps it turns after it lost an agent: all round
constexpr int AROUND = 10;          // steps it turns away from what stopped it
constexpr float SLOW = 0.05f;       // maximum speed at which it approaches, in tens of metres/s
constexpr int MIDDLE = 8;           // pixels left and right of the centre that must be free to walk
constexpr float CLOSE = 0.7f;       // depth at 3 m, near enough to an agent
constexpr float NEAR = 0.9f;        // depth at 1 m, too near to a wall
