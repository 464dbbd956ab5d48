// One thread per environment.
#include "place_objects.h"

KERNEL place_objects(PlaceObjectsParams p) {
    wait_for_previous();
    int env = blockIdx.x * blockDim.x + threadIdx.x;
    if (env < p.scenery.n_envs)
        place_objects_of(p, env);
}
