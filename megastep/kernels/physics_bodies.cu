// One warp per environment: a thread per slot, candidate and touch.
#include "physics_bodies.h"

KERNEL BOUNDS(16) physics_bodies(PhysicsBodiesParams p) {
    wait_for_previous();
    extern __shared__ int bodies_memory[];  // of a block's environments, without slots not there
    int words = (BODIES_BYTES - (MAX_SLOTS - n_slots_of(p)) * SLOT_BYTES) / (int)sizeof(int);
    int warp = threadIdx.x / WARP, env = blockIdx.x * (BLOCK / WARP) + warp;
    if (env < p.scenery.n_envs)
        move_bodies(p, this_warp(), *(Bodies*)(bodies_memory + warp * words), env);
}
