// One warp per environment: a thread per slot, candidate and touch.
#include "physics_bodies.h"

KERNEL BOUNDS(10) physics_bodies(PhysicsBodiesParams p) {
    wait_for_previous();
    __shared__ Bodies bodies[BLOCK / WARP];
    int warp = threadIdx.x / WARP, env = blockIdx.x * (BLOCK / WARP) + warp;
    if (env < p.scenery.n_envs)
        move_bodies(p, this_warp(), bodies[warp], env);
}
