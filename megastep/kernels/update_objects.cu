// One thread per object.
#include "update_objects.h"

KERNEL update_objects(UpdateObjectsParams p) {
    wait_for_previous();
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < p.scenery.n_envs * p.objects.n_objects)
        update_object(p, i);
}
