// Normalises a leaf of an observation into its columns of the network's input: (obs - mean) /
// scale. The bits are those of PyTorch's operations.
#include "common/backend.h"
#include "params.h"

constexpr long long MIN_PARALLEL = 1
                                   << 20;  // numbers; fewer take little longer than waking a thread

static inline float value_of(float x) { return x; }

static inline float value_of(unsigned short bits) { return HALF_VALUE(bits); }

template <class T>
static void normalise_row(const NormaliseLeafParams& p, const T* obs, float* out) {
    if (p.n_pixels == 1) {
#pragma omp simd
        for (int c = 0; c < p.n_channels; c++)
            out[c] = (value_of(obs[c]) - p.mean[c]) / p.scale[c];
        return;
    }
    for (int c = 0; c < p.n_channels; c++, obs += p.n_pixels, out += p.n_pixels) {
        float mean = p.mean[c], scale = p.scale[c];
#pragma omp simd
        for (int i = 0; i < p.n_pixels; i++)
            out[i] = (value_of(obs[i]) - mean) / scale;
    }
}

template <class T>
static void normalise_all(const NormaliseLeafParams& p) {
    long long size = (long long)p.n_channels * p.n_pixels;
    bool is_small = p.n_rows * size < MIN_PARALLEL;
#pragma omp parallel for schedule(static) num_threads(is_small ? 1 : p.n_threads)
    for (int row = 0; row < p.n_rows; row++)
        normalise_row(p, (const T*)p.obs + row * size, p.out + (long long)row * p.row_stride);
}

KERNEL normalise_leaf(const NormaliseLeafParams& p) {
    if (p.is_half)
        normalise_all<unsigned short>(p);
    else
        normalise_all<float>(p);
}
