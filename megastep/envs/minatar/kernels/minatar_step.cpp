// A loop over environments.
#include "minatar_step.h"

KERNEL minatar_step(const MinAtarStepParams& p) {
    int n_words = CELLS / 4 * p.n_channels;
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++) {
        unsigned int bits[WORDS];
        minatar_env(p, env, bits);
        for (int i = 0; i < n_words; i++) {
            unsigned int bytes = bytes_of(bits, i);
            __builtin_memcpy(p.image + 4ll * ((long long)n_words * env + i), &bytes, 4);
        }
    }
}
