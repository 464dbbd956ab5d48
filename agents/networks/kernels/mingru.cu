// The minGRU's recurrence over all steps, forward and backward, in float32. One thread per lane and
// n_units neighbouring units, whose states stay in registers: lanes and units fill a GPU, and every
// number is read once.
#include "lanes.h"
#include "params.h"

// The inputs of a step. They are loaded one step ahead, so that no step waits for GPU memory.
template <int N>
struct MingruInput {
    float update[N], candidate[N];
    bool reset;
};

template <class T, int N, class Params>
DEVICE void load(MingruInput<N>& input, const Params& p, const Place& place, int t) {
    long long gate = place.gate + 2ll * t * p.n_lanes * p.width;
    read<T>(input.update, p.gates, gate);
    read<T>(input.candidate, p.gates, gate + p.width);
    input.reset = p.reset[(long long)t * p.n_lanes + place.lane];
}

struct MingruForward {
    static constexpr int N_GATES = 2;

    template <class T, int N>
    DEVICE void run(const MingruForwardParams& p, const Place& place) {
        float state[N];
        read<float>(state, p.start, place.unit);
        MingruInput<N> input, next;
        load<T>(next, p, place, 0);
        for (int t = 0; t < p.n_steps; t++) {
            input = next;
            if (t + 1 < p.n_steps)
                load<T>(next, p, place, t + 1);
            if (input.reset)
                clear(state);
            for (int n = 0; n < N; n++)
                state[n] += sigmoid(input.update[n]) * (input.candidate[n] - state[n]);
            write<T>(p.outputs, place.unit + (long long)t * p.n_lanes * p.width, state);
        }
        write<float>(p.last, place.unit, state);
    }
};

// The inputs of a backward step: also the state before it, and the gradient of its output.
template <int N>
struct MingruBackwardInput {
    MingruInput<N> forward;
    float before[N], d_output[N];
};

template <class T, int N>
DEVICE void load_back(MingruBackwardInput<N>& input, const MingruBackwardParams& p,
                      const Place& place, int t) {
    long long rows = (long long)p.n_lanes * p.width, unit = place.unit + t * rows;
    load<T>(input.forward, p, place, t);
    read<T>(input.d_output, p.d_outputs, unit);
    if (t)
        read<T>(input.before, p.outputs, unit - rows);
    else
        read<float>(input.before, p.start, place.unit);
}

struct MingruBackward {
    static constexpr int N_GATES = 2;

    template <class T, int N>
    DEVICE void run(const MingruBackwardParams& p, const Place& place) {
        float d_state[N], d_update[N], d_candidate[N];
        read<float>(d_state, p.d_last, place.unit);
        MingruBackwardInput<N> input, next;
        load_back<T>(next, p, place, p.n_steps - 1);
        for (int t = p.n_steps - 1; t >= 0; t--) {
            input = next;
            if (t)
                load_back<T>(next, p, place, t - 1);
            if (input.forward.reset)
                clear(input.before);
            for (int n = 0; n < N; n++) {
                float z = sigmoid(input.forward.update[n]), d = d_state[n] + input.d_output[n];
                d_candidate[n] = d * z;
                d_update[n] =
                    d_candidate[n] * (1.f - z) * (input.forward.candidate[n] - input.before[n]);
                d_state[n] = d * (1.f - z);
            }
            if (input.forward.reset)
                clear(d_state);
            long long gate = place.gate + 2ll * t * p.n_lanes * p.width;
            write<T>(p.d_gates, gate, d_update);
            write<T>(p.d_gates, gate + p.width, d_candidate);
        }
        write<float>(p.d_start, place.unit, d_state);
    }
};

KERNEL BOUNDS(64) mingru_forward_float32(MingruForwardParams p) { run<MingruForward, float>(p); }
KERNEL BOUNDS(64) mingru_forward_bfloat16(MingruForwardParams p) {
    run<MingruForward, Bfloat16>(p);
}
KERNEL BOUNDS(64) mingru_backward_float32(MingruBackwardParams p) { run<MingruBackward, float>(p); }
KERNEL BOUNDS(64) mingru_backward_bfloat16(MingruBackwardParams p) {
    run<MingruBackward, Bfloat16>(p);
}
