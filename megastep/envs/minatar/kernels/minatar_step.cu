// One thread per environment. Then each warp writes images, four cells per thread at once.
#include "minatar_step.h"

KERNEL minatar_step(MinAtarStepParams p) {
    wait_for_previous();
    constexpr int STRIDE = WORDS + 1;  // so that threads write to different banks
    __shared__ unsigned int bits[STRIDE * BLOCK];
    int first_env = blockIdx.x * BLOCK, env = first_env + threadIdx.x;
    if (env < p.n_envs)
        minatar_env(p, env, bits + STRIDE * threadIdx.x);
    __syncthreads();
    int n_words = CELLS / 4 * p.n_channels, n_images = mini(BLOCK, p.n_envs - first_env);
    for (int image = threadIdx.x / WARP; image < n_images; image += BLOCK / WARP) {
        unsigned int* out = (unsigned int*)p.image + (long long)n_words * (first_env + image);
        for (int i = threadIdx.x % WARP; i < n_words; i += WARP)
            out[i] = bytes_of(bits + STRIDE * image, i);
    }
}
