// For many environments: so many threads per multiprocessor that 40 registers are left for each,
// which spills some.
#include "physics_cuda.h"

KERNEL BOUNDS(24) physics(PhysicsParams p) {
    wait_for_previous();
    move_agents<0>(p);
}
