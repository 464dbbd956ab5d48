#include "physics_bodies.h"

KERNEL physics_bodies(const PhysicsBodiesParams& p) {
    const SceneryParams& s = p.scenery;
    int n_threads = threads_for(s, s.n_envs * n_slots_of(p), 256);
#pragma omp parallel num_threads(n_threads)
    {
        Bodies bodies;
#pragma omp for schedule(static)
        for (int env = 0; env < s.n_envs; env++)
            move_bodies(p, SingleThread{0}, bodies, env);
    }
}
