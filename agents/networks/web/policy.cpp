// A policy's forward pass in float32, for a few lanes, with nothing but C++: what a browser runs.
#include <cmath>

#include "common/philox.h"
#include "params.h"

typedef float Four __attribute__((vector_size(16), aligned(4), may_alias));

constexpr int BLOCK = 16;  // channels whose sums stay in registers

static float sigmoid(float x) { return 1.f / (1.f + expf(-x)); }

static float activated(float x, int activation) {
    return activation == 1 ? (x > 0.f ? x : 0.f) : activation == 2 ? tanhf(x) : x;
}

static float number_at(const PolicyNormaliseParams& p, long long i) {
    switch (p.kind) {
        case 0:
            return half_value(((const unsigned short*)p.obs)[i]);
        case 1:
            return ((const float*)p.obs)[i];
        case 2:
            return (float)p.obs[i];
        default:
            return (float)((const long long*)p.obs)[i];
    }
}

KERNEL policy_normalise(const PolicyNormaliseParams& p) {
    for (int lane = 0; lane < p.n_lanes; lane++) {
        float* out = p.out + (long long)lane * p.out_stride;
        const float *mean = p.mean, *scale = p.scale;
        for (int a = 0; a < p.size0; a++)
            for (int b = 0; b < p.size1; b++)
                for (int c = 0; c < p.size2; c++)
                    for (int d = 0; d < p.size3; d++) {
                        float x = number_at(p, (long long)lane * p.obs_stride + a * p.stride0 +
                                                   b * p.stride1 + c * p.stride2 + d * p.stride3);
                        if (!p.choices)
                            *out++ = (x - *mean++) / *scale++;
                        for (int i = 0; i < p.choices; i++)
                            *out++ = x == (float)i;
                    }
    }
}

static Four products(const float* const rows[4], const float* x, int n) {
    Four sums[4] = {};
    int i = 0;
    for (; i + 4 <= n; i += 4)
        for (int r = 0; r < 4; r++)
            sums[r] += *(const Four*)(rows[r] + i) * *(const Four*)(x + i);
    Four out;
    for (int r = 0; r < 4; r++) {
        float sum = (sums[r][0] + sums[r][1]) + (sums[r][2] + sums[r][3]);
        for (int k = i; k < n; k++)
            sum += rows[r][k] * x[k];
        out[r] = sum;
    }
    return out;
}

KERNEL policy_linear(const PolicyLinearParams& p) {
    for (int lane = 0; lane < p.n_lanes; lane++) {
        const float* x = p.x + (long long)lane * p.x_stride;
        float* out = p.out + (long long)lane * p.out_stride;
        for (int first = 0; first < p.n_out; first += 4) {
            const float* rows[4];
            for (int r = 0; r < 4; r++) {
                int row = first + r < p.n_out ? first + r : p.n_out - 1;
                rows[r] = p.weight + (long long)row * p.n_in;
            }
            Four sums = products(rows, x, p.n_in);
            for (int r = 0; r < 4 && first + r < p.n_out; r++) {
                float y = sums[r] + (p.bias ? p.bias[first + r] : 0.f);
                y = p.adds ? out[first + r] + y : y;
                out[first + r] = activated(y, p.activation);
            }
        }
    }
}

// One output pixel of up to BLOCK channels from `channel` on.
static void convolve_pixel(const PolicyConvolveParams& p, const float* x, float* out, int channel,
                           int row, int column) {
    int top = row * p.stride_h - p.padding_h, left = column * p.stride_w - p.padding_w;
    int n = p.n_out - channel < BLOCK ? p.n_out - channel : BLOCK;
    Four sums[BLOCK / 4] = {};
    for (int in = 0; in < p.n_in; in++)
        for (int i = top < 0 ? -top : 0; i < p.kernel_h && top + i < p.height; i++)
            for (int j = left < 0 ? -left : 0; j < p.kernel_w && left + j < p.width; j++) {
                float value = x[(in * p.height + top + i) * p.width + left + j];
                int at = (in * p.kernel_h + i) * p.kernel_w + j;
                const float* weight = p.weight + (long long)at * p.n_out + channel;
                if (n == BLOCK)
                    for (int c = 0; c < BLOCK / 4; c++)
                        sums[c] += *(const Four*)(weight + 4 * c) * value;
                else
                    for (int c = 0; c < n; c++)
                        sums[c / 4][c % 4] += weight[c] * value;
            }
    for (int c = 0; c < n; c++) {
        int at = ((channel + c) * p.out_height + row) * p.out_width + column;
        out[at] = activated(sums[c / 4][c % 4] + p.bias[channel + c], 1);
    }
}

static void convolve_image(const PolicyConvolveParams& p, const float* x, float* out) {
    for (int channel = 0; channel < p.n_out; channel += BLOCK)
        for (int row = 0; row < p.out_height; row++)
            for (int column = 0; column < p.out_width; column++)
                convolve_pixel(p, x, out, channel, row, column);
}

KERNEL policy_convolve(const PolicyConvolveParams& p) {
    int n_in = p.n_in * p.height * p.width, n_out = p.n_out * p.out_height * p.out_width;
    for (int lane = 0; lane < p.n_lanes; lane++)
        for (int image = 0; image < p.n_images; image++)
            convolve_image(p, p.x + (long long)lane * p.x_stride + image * n_in,
                           p.out + (long long)lane * p.out_stride + image * n_out);
}

KERNEL policy_clear(const PolicyClearParams& p) {
    for (int lane = 0; lane < p.n_lanes; lane++)
        for (int i = 0; p.reset[lane] && i < p.width; i++)
            p.state[(long long)lane * p.width + i] = 0.f;
}

KERNEL policy_lstm(const PolicyCellParams& p) {
    int width = p.width;
    for (int lane = 0; lane < p.n_lanes; lane++) {
        const float* gates = p.gates + 4ll * lane * width;
        for (int i = 0; i < width; i++) {
            long long at = (long long)lane * width + i;
            float cell = sigmoid(gates[width + i]) * p.cell[at] +
                         sigmoid(gates[i]) * tanhf(gates[2 * width + i]);
            p.cell[at] = cell;
            p.output[at] = sigmoid(gates[3 * width + i]) * tanhf(cell);
            p.x[at] += p.output[at];
        }
    }
}

KERNEL policy_mingru(const PolicyCellParams& p) {
    int width = p.width;
    for (int lane = 0; lane < p.n_lanes; lane++) {
        const float* gates = p.gates + 2ll * lane * width;
        for (int i = 0; i < width; i++) {
            long long at = (long long)lane * width + i;
            float update = sigmoid(gates[i]);
            p.output[at] = (1.f - update) * p.output[at] + update * gates[width + i];
            p.x[at] += p.output[at];
        }
    }
}

KERNEL policy_add(const PolicyAddParams& p) {
    for (int i = 0; i < p.n; i++)
        p.out[i] += p.x[i];
}

static float uniform(const PolicyActParams& p, int lane) {
    return unit_float(philox((unsigned int)(p.first + lane), p.counts[lane]++, p.key0, p.key1).a);
}

static int best_of(const float* logits, int n) {
    int best = 0;
    for (int i = 1; i < n; i++)
        best = logits[i] > logits[best] ? i : best;
    return best;
}

KERNEL policy_softmax(const PolicyActParams& p) {
    int n = p.n_choices;
    for (int row = 0; row < p.n_lanes * p.n_agents; row++) {
        const float* scores = p.scores + (long long)row * n;
        float *logits = p.logits + (long long)row * n, sum = 0.f;
        float most = scores[best_of(scores, n)];
        for (int i = 0; i < n; i++)
            sum += expf(scores[i] - most);
        for (int i = 0; i < n; i++)
            logits[i] = scores[i] - most - logf(sum);
        int action = best_of(logits, n);
        if (!p.greedy) {
            float left = uniform(p, row / p.n_agents);
            for (int i = 0; i < n; i++) {
                left -= expf(logits[i]);
                if (left < 0.f) {
                    action = i;
                    break;
                }
            }
        }
        p.actions[row] = action;
    }
}
