// As physics_unspilled.cu, with objects.
#include "physics_cuda.h"

KERNEL BOUNDS(18) physics_objects_unspilled(PhysicsParams p) {
    wait_for_previous();
    move_agents<1>(p);
}
