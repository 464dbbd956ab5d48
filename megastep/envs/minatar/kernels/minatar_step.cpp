// A loop over environments. Each writes its image eight cells at once.
#include "minatar_step.h"

static void write_image(const unsigned int* bits, unsigned char* image, int n_words) {
    const unsigned long long ones = 0x0101010101010101ull, seventh = 0x7f7f7f7f7f7f7f7full;
    for (int i = 0; i < n_words / 2; i++) {
        unsigned long long cells = bits[i >> 2] >> 8 * (i & 3) & 255u;
        // byte k keeps bit k, which is carried to its highest bit
        unsigned long long bytes = (cells * ones & 0x8040201008040201ull) + seventh >> 7 & ones;
        __builtin_memcpy(image + 8 * i, &bytes, 8);
    }
    if (n_words & 1) {
        unsigned int bytes = bytes_of(bits, n_words - 1);
        __builtin_memcpy(image + 4 * (n_words - 1), &bytes, 4);
    }
}

KERNEL minatar_step(const MinAtarStepParams& p) {
    int n_words = CELLS / 4 * p.n_channels;
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++) {
        unsigned int bits[WORDS];
        minatar_env(p, env, bits);
        write_image(bits, p.image + 4ll * n_words * env, n_words);
    }
}
