// `physics` is for many environments: so many threads per multiprocessor that 40 registers are left
// for each, which spills some. `unspilled` has fewer, with 56 registers each: faster until there
// are many.
#include "physics_cuda.h"

KERNEL BOUNDS(24) physics(PhysicsParams p) {
    wait_for_previous();
    move_agents<0>(p);
}

KERNEL BOUNDS(24) physics_objects(PhysicsParams p) {
    wait_for_previous();
    move_agents<1>(p);
}

KERNEL BOUNDS(18) physics_unspilled(PhysicsParams p) {
    wait_for_previous();
    move_agents<0>(p);
}

KERNEL BOUNDS(18) physics_objects_unspilled(PhysicsParams p) {
    wait_for_previous();
    move_agents<1>(p);
}
