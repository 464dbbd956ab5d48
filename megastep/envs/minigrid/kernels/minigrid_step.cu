// One thread per environment. Then the block writes its images together, four bytes at once.
#include "minigrid_step.h"

KERNEL minigrid_step(MiniGridStepParams p) {
    wait_for_previous();
    constexpr int SIZE = 3 * VIEW * VIEW;
    __shared__ unsigned int words[SIZE * BLOCK / 4];
    unsigned char* images = (unsigned char*)words;
    int first_env = blockIdx.x * BLOCK, env = first_env + threadIdx.x;
    if (env < p.n_envs)
        minigrid_env(p, env, images + SIZE * threadIdx.x);
    __syncthreads();
    int n_bytes = SIZE * mini(BLOCK, p.n_envs - first_env);
    unsigned char* out = p.image + (long long)SIZE * first_env;
    for (int i = threadIdx.x; i < n_bytes / 4; i += BLOCK)
        ((unsigned int*)out)[i] = words[i];
    for (int i = n_bytes / 4 * 4 + threadIdx.x; i < n_bytes; i += BLOCK)
        out[i] = images[i];
}
