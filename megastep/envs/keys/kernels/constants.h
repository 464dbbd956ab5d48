// Constants of Keys that Python reads too: one per line, a plain number each.
#pragma once

constexpr int OPEN = -1;  // the state of a doorway without a door
