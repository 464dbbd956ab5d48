// Constants of hide and seek that Python reads too: one per line, a plain number each.
#pragma once

constexpr int GRAB = 7;     // actions beside the moves: grab a body or let go
constexpr int LOCK = 8;     // lock or unlock a body
constexpr int N_KINDS = 3;  // of bodies, each with a colour; those of the teams' locks come next
constexpr int STATE = 9;    // numbers that an agent observes beside images
constexpr int TALLY = 5;    // of an episode so far: steps unseen, and four of PHASE
constexpr int PHASE = 4;    // box moved and locked, ramp moved and locked
constexpr int METRICS = 9;  // steps unseen, and PHASE at the end of either phase
constexpr int PRIVILEGED_PER_AGENT = 5;  // numbers that a critic sees of each other agent
constexpr int PRIVILEGED_PER_BODY = 7;
