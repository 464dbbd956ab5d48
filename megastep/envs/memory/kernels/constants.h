// Constants of Memory that Python reads too: one per line, a plain number each.
#pragma once

constexpr int N_PRIVILEGED = 4;  // numbers that a critic sees
