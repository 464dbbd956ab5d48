// One step of the LSTM for few lanes: the product of its gates and the cell's update in one kernel,
// without shared memory.
//
// A warp computes 8 units of 16 lanes. The two tiles of its weights are the input and forget gates,
// and the candidates and output gates, of these units. Of the 16 x 8 results of a tile and eight
// lanes, a thread holds rows g and g + 8 and lanes 2 q and 2 q + 1, with g = thread / 4 and
// q = thread % 4 of the warp: all four gates of a unit, which never leave it.
//
// A thread reads 16 bytes of a row at once, eight numbers of the product's inner axis. So the order
// in which they are added is another than the axis', and the same for weights and lanes.
#include "bits.h"
#include "constants.h"
#include "params.h"
#include "common/dependent_launch.h"
#include "common/tensor_cores.h"

constexpr int COLUMNS = 2;  // of eight lanes, of a warp
constexpr int WARP_LANES = 8 * COLUMNS;
constexpr int INNER = 32;  // numbers of the inner axis at once

static_assert(STEP_LANES == STEP_THREADS / 32 * WARP_LANES && STEP_UNITS == 8, "see above");

DEVICE uint4 read_words(const Bits* at) { return *(const uint4*)at; }

// Rounds eight numbers, as a thread reads them.
DEVICE uint4 read_rounded(const float* at) {
    float4 a = ((const float4*)at)[0], b = ((const float4*)at)[1];
    return {pack_bfloat16(a.x, a.y), pack_bfloat16(a.z, a.w), pack_bfloat16(b.x, b.y),
            pack_bfloat16(b.z, b.w)};
}

// Adds the products of 32 numbers of the inner axis. `weights` has rows g and g + 8 of each tile.
DEVICE void multiply_words(float (&sums)[2][COLUMNS][4], const uint4 (&weights)[2][2],
                           const uint4 (&lanes)[COLUMNS]) {
#pragma unroll
    for (int tile = 0; tile < 2; tile++) {
        const uint4 &near = weights[tile][0], &far = weights[tile][1];
        unsigned int first[4] = {near.x, far.x, near.y, far.y};
        unsigned int second[4] = {near.z, far.z, near.w, far.w};
#pragma unroll
        for (int j = 0; j < COLUMNS; j++) {
            multiply_add(sums[tile][j], first, lanes[j].x, lanes[j].y);
            multiply_add(sums[tile][j], second, lanes[j].z, lanes[j].w);
        }
    }
}

DEVICE void write_bfloat16(void* array, long long index, float x) {
    ((Bits*)array)[index] = (Bits)pack_bfloat16(x, 0.f);
}

template <int W>
DEVICE void lstm_step(const LstmStepParams& p) {
    constexpr int UNIT_BLOCKS = W / 8;
    int thread = threadIdx.x % 32, g = thread / 4, q = thread % 4, n = p.n_lanes;
    int first_unit = 8 * (blockIdx.x % UNIT_BLOCKS), unit = first_unit + g;
    int first_lane =
        WARP_LANES * (blockIdx.x / UNIT_BLOCKS * (STEP_THREADS / 32) + threadIdx.x / 32);
    if (first_lane >= n)
        return;
    const Bits* weight = (const Bits*)p.weight + (long long)unit * 2 * W + 8 * q;
    const Bits* x[COLUMNS];
    const float* hidden[COLUMNS];
    bool is_reset[COLUMNS];
#pragma unroll
    for (int j = 0; j < COLUMNS; j++) {  // a lane that does not exist is the last one
        long long lane = min(first_lane + 8 * j + g, n - 1);
        x[j] = (const Bits*)p.x + lane * W + 8 * q;
        hidden[j] = p.last_output + lane * W + 8 * q;
        is_reset[j] = p.reset[lane];
    }
    float sums[2][COLUMNS][4];
#pragma unroll
    for (int gate = 0; gate < 4; gate++) {
        float bias = low_half(((const Bits*)p.bias)[gate * W + unit]);
#pragma unroll
        for (int j = 0; j < COLUMNS; j++)
            sums[gate / 2][j][gate % 2 * 2] = sums[gate / 2][j][gate % 2 * 2 + 1] = bias;
    }
#pragma unroll 8
    for (int k = 0; k < 2 * W; k += INNER) {
        uint4 weights[2][2], lanes[COLUMNS];
#pragma unroll
        for (int gate = 0; gate < 4; gate++)
            weights[gate / 2][gate % 2] = read_words(weight + gate * W * 2 * W + k);
#pragma unroll
        for (int j = 0; j < COLUMNS; j++) {
            if (k < W)
                lanes[j] = read_words(x[j] + k);
            else
                lanes[j] = is_reset[j] ? uint4{0, 0, 0, 0} : read_rounded(hidden[j] + k - W);
        }
        multiply_words(sums, weights, lanes);
    }
#pragma unroll
    for (int j = 0; j < COLUMNS; j++)
#pragma unroll
        for (int i = 0; i < 2; i++) {
            int lane = first_lane + 8 * j + 2 * q + i;
            if (lane >= n)
                continue;
            long long at = (long long)lane * W + unit;
            float before = p.reset[lane] ? 0.f : p.last_cell[at];
            float input = sigmoid(sums[0][j][i]), forget = sigmoid(sums[0][j][2 + i]);
            float candidate = tanh_of(sums[1][j][i]), output = sigmoid(sums[1][j][2 + i]);
            float after = forget * before + input * candidate;
            // rounded, as when learning
            float hidden = low_half(pack_bfloat16(output * tanh_of(after), 0.f));
            p.next_output[at] = hidden;
            p.next_cell[at] = after;
            if (p.is_residual)
                hidden += low_half(((const Bits*)p.x)[at]);
            write_bfloat16(p.output, at, hidden);
        }
}

INSTANCE(BOUNDS(128) lstm_step_128, LstmStepParams, lstm_step<128>)
INSTANCE(BOUNDS(128) lstm_step_256, LstmStepParams, lstm_step<256>)
