// As physics.cu, with objects.
#include "physics_cuda.h"

KERNEL BOUNDS(24) physics_objects(PhysicsParams p) {
    wait_for_previous();
    move_agents<1>(p);
}
