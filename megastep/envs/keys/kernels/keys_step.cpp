// A loop over environments.
#include "keys_step.h"

KERNEL keys_step(const KeysStepParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int env = 0; env < s.n_envs; env++)
        keys_env(p, env);
}
