// A loop over objects.
#include "update_objects.h"

constexpr int MIN_PARALLEL = 1024;  // objects

KERNEL update_objects(const UpdateObjectsParams& p) {
    int n = p.scenery.n_envs * p.objects.n_objects;
    int n_threads = threads_for(p.scenery, n, MIN_PARALLEL);
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int i = 0; i < n; i++)
        update_object(p, i);
}
