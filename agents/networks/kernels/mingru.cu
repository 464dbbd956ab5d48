// The minGRU's recurrence over all steps, forward and backward, in float32. One thread per lane and
// n_units neighbouring units, whose states stay in registers: lanes and units fill a GPU, and every
// number is read once.
//
// The inputs of a step are loaded STEPS_AHEAD steps before it and converted only when it comes, so
// that steps do not wait for GPU memory. Loads have no conditions and come last in a step:
// otherwise the compiler would copy what they load, and so wait for it. The last steps' loads are
// not used.
#include "common/numbers.h"
#include "params.h"

constexpr int STEPS_AHEAD = 4;

// A thread's lane, and the offsets of its units in an array (B, W) and in the update gates of an
// array (B, 2 W).
struct UnitIndex {
    int lane;
    long long unit, gate;
};

template <class Params>
DEVICE bool find_index(const Params& p, UnitIndex& index) {
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x;
    unsigned int threads_per_lane = p.width / p.n_units;
    unsigned int lane = thread / threads_per_lane;
    long long first = thread % threads_per_lane * p.n_units, row = (long long)lane * p.width;
    index = {(int)lane, row + first, 2 * row + first};
    return lane < (unsigned int)p.n_lanes;
}

// For large |x| the exponential is 0 or infinite and the quotient 1 or 0. NaN stays NaN.
DEVICE float sigmoid(float x) { return __fdividef(1.f, 1.f + __expf(-x)); }

template <class T, int N>
struct MingruGates {
    Pack<T, N> update, candidate;
    unsigned char reset;
};

// Where a thread's units are in step t of an array (T, B, W), and in that of gates (T, B, 2 W).
template <class Params>
DEVICE long long unit_at(const Params& p, const UnitIndex& index, int t) {
    return index.unit + t * ((long long)p.n_lanes * p.width);
}

template <class Params>
DEVICE long long gate_at(const Params& p, const UnitIndex& index, int t) {
    return index.gate + t * (2ll * p.n_lanes * p.width);
}

template <class T, int N, class Params>
DEVICE void load(MingruGates<T, N>& gates, const Params& p, const UnitIndex& index, int t) {
    long long gate = gate_at(p, index, t);
    load(gates.update, p.gates, gate);
    load(gates.candidate, p.gates, gate + p.width);
    gates.reset = p.reset[(long long)t * p.n_lanes + index.lane];
}

template <class T, int N>
struct MingruForwardInput {
    MingruGates<T, N> gates;
    Pack<T, N> residual;
};

template <class T, int N>
DEVICE void load(MingruForwardInput<T, N>& input, const MingruForwardParams& p,
                 const UnitIndex& index, int t) {
    load(input.gates, p, index, t);
    if (p.residual)
        load(input.residual, p.residual, unit_at(p, index, t));
}

template <class T, int N>
DEVICE void forward_step(const MingruForwardParams& p, long long unit,
                         const MingruForwardInput<T, N>& input, float (&state)[N]) {
    float update[N], candidate[N], output[N];
    unpack(update, input.gates.update);
    unpack(candidate, input.gates.candidate);
    if (input.gates.reset)
        clear(state);
    clear(output);
    if (p.residual)
        unpack(output, input.residual);
    for (int n = 0; n < N; n++) {
        state[n] += sigmoid(update[n]) * (candidate[n] - state[n]);
        output[n] += state[n];
    }
    write<T>(p.outputs, unit, output);
    if (p.states)
        write<T>(p.states, unit, state);
}

template <class T, int N>
DEVICE void forward(const MingruForwardParams& p, const UnitIndex& index) {
    int n_steps = p.n_steps;
    float state[N];
    MingruForwardInput<T, N> inputs[STEPS_AHEAD];
    for (int i = 0; i < STEPS_AHEAD; i++)
        load(inputs[i], p, index, min(i, n_steps - 1));
    read<float>(state, p.start, index.unit);
    for (int first = 0; first < n_steps; first += STEPS_AHEAD) {
        for (int i = 0; i < STEPS_AHEAD; i++) {
            int t = first + i;
            if (t >= n_steps)
                break;
            forward_step(p, unit_at(p, index, t), inputs[i], state);
            load(inputs[i], p, index, min(t + STEPS_AHEAD, n_steps - 1));
        }
    }
    write<float>(p.last, index.unit, state);
}

// The inputs of a backward step: also the state before it, and the gradient of its output.
template <class T, int N>
struct MingruBackwardInput {
    MingruGates<T, N> gates;
    Pack<T, N> before, d_output;
};

// At the first step, `before` is not used.
template <class T, int N>
DEVICE void load(MingruBackwardInput<T, N>& input, const MingruBackwardParams& p,
                 const UnitIndex& index, int t) {
    load(input.gates, p, index, t);
    load(input.d_output, p.d_outputs, unit_at(p, index, t));
    load(input.before, p.states, unit_at(p, index, max(t - 1, 0)));
}

// Gradients of a thread's units: of the state, and of the gates summed over steps.
template <int N>
struct MingruGradients {
    float state[N], update_sum[N], candidate_sum[N];
};

template <class T, int N>
DEVICE void backward_step(const MingruBackwardParams& p, const UnitIndex& index, int t,
                          const MingruBackwardInput<T, N>& input, float (&before)[N],
                          MingruGradients<N>& d) {
    float update[N], candidate[N], d_output[N], d_update[N], d_candidate[N];
    unpack(update, input.gates.update);
    unpack(candidate, input.gates.candidate);
    unpack(d_output, input.d_output);
    if (input.gates.reset)
        clear(before);
    for (int n = 0; n < N; n++) {
        float z = sigmoid(update[n]), d_state = d.state[n] + d_output[n];
        d_candidate[n] = d_state * z;
        d_update[n] = d_candidate[n] * (1.f - z) * (candidate[n] - before[n]);
        d.state[n] = d_state * (1.f - z);
        d.update_sum[n] += d_update[n];
        d.candidate_sum[n] += d_candidate[n];
    }
    if (input.gates.reset)
        clear(d.state);
    if (p.d_residual)
        write<T>(p.d_residual, unit_at(p, index, t), d_output);
    long long gate = gate_at(p, index, t);
    write<T>(p.d_gates, gate, d_update);
    write<T>(p.d_gates, gate + p.width, d_candidate);
}

// All steps of a thread's units. Adds its gates' gradients to the sums of `d`.
template <class T, int N>
DEVICE void backward_steps(const MingruBackwardParams& p, const UnitIndex& index,
                           MingruGradients<N>& d) {
    MingruBackwardInput<T, N> inputs[STEPS_AHEAD];
    for (int i = 0; i < STEPS_AHEAD; i++)
        load(inputs[i], p, index, max(p.n_steps - 1 - i, 0));
    float start[N];
    read<float>(start, p.start, index.unit);
    if (p.d_last)
        read<float>(d.state, p.d_last, index.unit);
    for (int last = p.n_steps - 1; last >= 0; last -= STEPS_AHEAD) {
        for (int i = 0; i < STEPS_AHEAD; i++) {
            int t = last - i;
            if (t < 0)
                break;
            float before[N];
            unpack(before, inputs[i].before);
            for (int n = 0; n < N; n++)
                before[n] = t ? before[n] : start[n];
            backward_step(p, index, t, inputs[i], before, d);
            load(inputs[i], p, index, max(t - STEPS_AHEAD, 0));
        }
    }
    if (p.d_start)
        write<float>(p.d_start, index.unit, d.state);
}

// Adds up a gate's sums over the lanes of the block, in order, and writes its row of d_biases.
template <int N>
DEVICE void add_lanes(const float (&sums)[N], int width, float* target) {
    extern __shared__ float of_lanes[];
    __syncthreads();  // an earlier call may still be reading
    for (int n = 0; n < N; n++)
        of_lanes[threadIdx.x * N + n] = sums[n];
    __syncthreads();
    for (int unit = threadIdx.x; unit < width; unit += blockDim.x) {
        float total = 0.f;
        for (int i = unit; i < N * (int)blockDim.x; i += width)
            total += of_lanes[i];
        target[unit] = total;
    }
}

template <class T, int N>
DEVICE void backward(const MingruBackwardParams& p) {
    UnitIndex index;
    bool exists = find_index(p, index);
    MingruGradients<N> d;
    clear(d.state);
    clear(d.update_sum);
    clear(d.candidate_sum);
    if (exists)
        backward_steps<T>(p, index, d);
    if (p.adds_lanes) {
        float* row = p.d_biases + 2ll * p.width * blockIdx.x;
        add_lanes(d.update_sum, p.width, row);
        add_lanes(d.candidate_sum, p.width, row + p.width);
    } else if (exists) {
        write<float>(p.d_biases, index.gate, d.update_sum);
        write<float>(p.d_biases, index.gate + p.width, d.candidate_sum);
    }
}

template <class T>
DEVICE void forward(const MingruForwardParams& p) {
    UnitIndex index;
    if (!find_index(p, index))
        return;
    if (p.n_units == 4)
        forward<T, 4>(p, index);
    else
        forward<T, 1>(p, index);
}

template <class T>
DEVICE void backward(const MingruBackwardParams& p) {
    if (p.n_units == 4)
        backward<T, 4>(p);
    else
        backward<T, 1>(p);
}

INSTANCE(__launch_bounds__(64) mingru_forward_float32, MingruForwardParams, forward<float>)
INSTANCE(__launch_bounds__(64) mingru_forward_bfloat16, MingruForwardParams, forward<Bfloat16>)
INSTANCE(__launch_bounds__(256) mingru_backward_float32, MingruBackwardParams, backward<float>)
INSTANCE(__launch_bounds__(256) mingru_backward_bfloat16, MingruBackwardParams, backward<Bfloat16>)
