// `physics` is for many environments: so many threads per multiprocessor that 40 registers are left
// for each, which spills some. `unspilled` has fewer, with 56 registers each: faster until there
// are many.
#include "physics_cuda.h"

INSTANCE(BOUNDS(24) physics, PhysicsParams, move_agents<0>)
INSTANCE(BOUNDS(24) physics_objects, PhysicsParams, move_agents<1>)
INSTANCE(BOUNDS(18) physics_unspilled, PhysicsParams, move_agents<0>)
INSTANCE(BOUNDS(18) physics_objects_unspilled, PhysicsParams, move_agents<1>)
