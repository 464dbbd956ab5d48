// A loop over environments.
#include "memory_step.h"

KERNEL memory_step(const MemoryStepParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int env = 0; env < s.n_envs; env++)
        memory_env(p, env);
}
