// As physics.cu, but fewer threads per multiprocessor, with 56 registers each: faster until there
// are many environments.
#include "physics_cuda.h"

KERNEL BOUNDS(18) physics_unspilled(PhysicsParams p) {
    wait_for_previous();
    move_agents<0>(p);
}
