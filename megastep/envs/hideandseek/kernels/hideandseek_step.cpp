// A loop over environments.
#include "hideandseek_step.h"

KERNEL hideandseek_step(const HideAndSeekStepParams& p) {
    const SceneryParams& s = p.scenery;
    int n_threads = threads_for(s, s.n_envs * s.n_agents, 256);
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int env = 0; env < s.n_envs; env++)
        hideandseek_env(p, SingleThread{0}, env);
}
