// A loop over environments.
#include "place_objects.h"

constexpr int MIN_PARALLEL = 1024;  // environments

KERNEL place_objects(const PlaceObjectsParams& p) {
    int n_threads = threads_for(p.scenery, p.scenery.n_envs, MIN_PARALLEL);
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int env = 0; env < p.scenery.n_envs; env++)
        place_objects_of(p, env);
}
