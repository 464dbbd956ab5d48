// The LSTM over a whole sequence: a loop over lanes. A thread takes its lanes from the first step
// to the last, so threads never wait for each other. Sums stay in registers from the products to
// the output.
#include <memory>

#include "params.h"
#include "vector.h"

// Returns the number of threads for a sequence. Waking a sleeping thread takes 50 us; 2^22
// multiples of a lane's W^2 at a step take a thread 500 us.
template <class Params>
static int threads_of(const Params& p) {
    long long size = (long long)p.n_steps * p.n_lanes * p.width * p.width;
    return size < 1 << 22 ? 1 : p.n_threads;
}

// Calls tile<N>(lane), which does N lanes, for the lanes [first, end).
#define FOR_TILES(tile, first, end, ...)         \
    {                                            \
        int lane = first;                        \
        for (; lane + ROWS <= end; lane += ROWS) \
            tile<ROWS>(__VA_ARGS__, lane);       \
        for (; lane < end; lane++)               \
            tile<1>(__VA_ARGS__, lane);          \
    }

// ---- Forward ----

// Copies both weights, so that a product reads them in order: for SIZE units after SIZE units, for
// each input and then each last output, their four gates.
static void pack(const LstmSequenceForwardParams& p, int first_unit, float* packed) {
    int w = p.width;
    const float* weights[] = {p.input_weight, p.weight};
    for (int m = 0; m < 2; m++)
        for (int gate = 0; gate < 4; gate++)
            for (int u = 0; u < SIZE; u++) {
                const float* row = weights[m] + (long long)(gate * w + first_unit + u) * w;
                float* column = packed + 4 * SIZE * (m * w) + gate * SIZE + u;
                for (int k = 0; k < w; k++)
                    column[4 * SIZE * k] = row[k];
            }
}

// Adds the product of N rows, w apart, and packed weights.
template <int N>
static inline void add_product(Vector (&sums)[N][4], const float* rows, const float* packed,
                               int w) {
    for (int k = 0; k < w; k++, packed += 4 * SIZE) {
        Vector weights[4];
#pragma GCC unroll 4
        for (int gate = 0; gate < 4; gate++) {
            weights[gate] = load(packed + gate * SIZE);
            IN_REGISTER(weights[gate]);
        }
#pragma GCC unroll 4
        for (int n = 0; n < N; n++)
#pragma GCC unroll 4
            for (int gate = 0; gate < 4; gate++)
                sums[n][gate] =
                    multiply_add(rows[(long long)n * w + k], weights[gate], sums[n][gate]);
    }
}

// SIZE units of N lanes at step t.
template <int N>
static void forward_tile(const LstmSequenceForwardParams& p, const float* packed, int t, int unit,
                         int lane) {
    int w = p.width;
    long long row = (long long)t * p.n_lanes + lane;
    Vector sums[N][4];
#pragma GCC unroll 4
    for (int n = 0; n < N; n++)
#pragma GCC unroll 4
        for (int gate = 0; gate < 4; gate++)
            sums[n][gate] = load(p.bias + gate * w + unit);
    add_product(sums, p.x + row * w, packed, w);
    add_product(sums, p.hiddens + row * w, packed + 4 * SIZE * w, w);
#pragma GCC unroll 4
    for (int n = 0; n < N; n++) {
        long long at = (row + n) * w + unit;
        Vector i = sigmoid(sums[n][0]), f = sigmoid(sums[n][1]);
        Vector g = tanh_of(sums[n][2]), o = sigmoid(sums[n][3]);
        Vector cell = f * load(p.cells + at) + i * g;
        Vector output = o * tanh_of(cell);
        float* gates = p.gates + (row + n) * 4 * w + unit;
        store(gates, i);
        store(gates + w, f);
        store(gates + 2 * w, g);
        store(gates + 3 * w, o);
        store(p.outputs + at, output);
        if (t + 1 == p.n_steps) {
            store(p.last_cell + (long long)(lane + n) * w + unit, cell);
            continue;
        }
        bool resets = p.reset[row + n + p.n_lanes];
        long long next = at + (long long)p.n_lanes * w;
        store(p.hiddens + next, resets ? Vector{} : output);
        store(p.cells + next, resets ? Vector{} : cell);
    }
}

static void forward_lanes(const LstmSequenceForwardParams& p, const float* packed, int first,
                          int end) {
    int w = p.width;
    for (int lane = first; lane < end; lane++)
        for (long long at = (long long)lane * w; at < (long long)(lane + 1) * w; at++) {
            p.hiddens[at] = p.reset[lane] ? 0.f : p.first_output[at];
            p.cells[at] = p.reset[lane] ? 0.f : p.first_cell[at];
        }
    for (int t = 0; t < p.n_steps; t++)
        for (int unit = 0; unit < w; unit += SIZE)
            FOR_TILES(forward_tile, first, end, p, packed + 8LL * w * unit, t, unit)
}

KERNEL lstm_sequence_forward(const LstmSequenceForwardParams& p) {
    int w = p.width, n_threads = threads_of(p);
    std::unique_ptr<Vector[]> vectors(new Vector[8LL * w * w / SIZE]);  // aligned, unlike floats
    float* packed = (float*)vectors.get();
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int unit = 0; unit < w; unit += SIZE)
        pack(p, unit, packed + 8LL * w * unit);
    on_threads(p.n_lanes, ROWS, n_threads,
               [&](int first, int end) { forward_lanes(p, packed, first, end); });
}

// ---- Backward ----

// The gradients of the gates of N lanes at step t. `d_output` and `d_cell` hold those of the next
// step's input state, then `d_cell` that of this step's.
template <int N>
static void gates_tile(const LstmSequenceBackwardParams& p, int t, int lane) {
    int w = p.width;
    bool is_last = t + 1 == p.n_steps;
    for (int n = 0; n < N; n++) {
        long long row = (long long)t * p.n_lanes + lane + n;
        bool resets = !is_last && p.reset[row + p.n_lanes];
        const float* gates = p.gates + row * 4 * w;
        float* d_gates = p.d_gates + row * 4 * w;
        for (int unit = 0; unit < w; unit += SIZE) {
            long long at = (long long)(lane + n) * w + unit;
            Vector i = load(gates + unit), f = load(gates + w + unit);
            Vector g = load(gates + 2 * w + unit), o = load(gates + 3 * w + unit);
            Vector before = load(p.cells + row * w + unit);
            Vector after = tanh_of(f * before + i * g);
            Vector d_h = load(p.d_outputs + row * w + unit), d_after = {};
            if (is_last)
                d_after = load(p.d_last_cell + at);
            else if (!resets) {
                d_h += load(p.d_output + at);
                d_after = load(p.d_cell + at);
            }
            d_after += d_h * o * (1.f - after * after);
            store(d_gates + unit, d_after * g * i * (1.f - i));
            store(d_gates + w + unit, d_after * before * f * (1.f - f));
            store(d_gates + 2 * w + unit, d_after * i * (1.f - g * g));
            store(d_gates + 3 * w + unit, d_h * after * o * (1.f - o));
            store(p.d_cell + at, d_after * f);
        }
    }
}

// N rows of M vectors of d_gates @ weight.
template <int N, int M>
static inline void product(const float* d_gates, const float* weight, float* out, int w) {
    Vector sums[N][M] = {};
    for (int k = 0; k < 4 * w; k++, weight += w) {
        Vector weights[M];
#pragma GCC unroll 4
        for (int m = 0; m < M; m++) {
            weights[m] = load(weight + m * SIZE);
            IN_REGISTER(weights[m]);
        }
#pragma GCC unroll 4
        for (int n = 0; n < N; n++)
#pragma GCC unroll 4
            for (int m = 0; m < M; m++)
                sums[n][m] += d_gates[(long long)n * 4 * w + k] * weights[m];
    }
#pragma GCC unroll 4
    for (int n = 0; n < N; n++)
#pragma GCC unroll 4
        for (int m = 0; m < M; m++)
            store(out + (long long)n * w + m * SIZE, sums[n][m]);
}

template <int N>
static void product_tile(const float* d_gates, const float* weight, float* out, int w, int lane) {
    d_gates += (long long)lane * 4 * w;
    out += (long long)lane * w;
    int unit = 0;
    for (; unit + 4 * SIZE <= w; unit += 4 * SIZE)
        product<N, 4>(d_gates, weight + unit, out + unit, w);
    for (; unit < w; unit += SIZE)
        product<N, 1>(d_gates, weight + unit, out + unit, w);
}

static void backward_lanes(const LstmSequenceBackwardParams& p, int first, int end) {
    int w = p.width;
    for (int t = p.n_steps - 1; t >= 0; t--) {
        long long row = (long long)t * p.n_lanes;
        FOR_TILES(gates_tile, first, end, p, t)
        const float* d_gates = p.d_gates + row * 4 * w;
        FOR_TILES(product_tile, first, end, d_gates, p.input_weight, p.d_x + row * w, w)
        FOR_TILES(product_tile, first, end, d_gates, p.weight, p.d_output, w)
    }
    for (int lane = first; lane < end; lane++)
        if (p.reset[lane])
            for (long long at = (long long)lane * w; at < (long long)(lane + 1) * w; at++) {
                p.d_output[at] = 0.f;
                p.d_cell[at] = 0.f;
            }
}

KERNEL lstm_sequence_backward(const LstmSequenceBackwardParams& p) {
    on_threads(p.n_lanes, ROWS, threads_of(p),
               [&](int first, int end) { backward_lanes(p, first, end); });
}
