// The minGRU's recurrence in float32, over all steps and back. One thread per lane and n_units
// neighbouring units, which stay in its registers: lanes and units fill a GPU, and every number is
// read once.
#include "lanes.h"
#include "params.h"

// What a step is given. Each is loaded before the step before it is computed, or every step would
// wait for memory.
template <int N>
struct MingruGiven {
    float update[N], candidate[N];
    bool reset;
};

template <class T, int N, class Params>
DEVICE void load(MingruGiven<N>& given, const Params& p, const Place& place, int t) {
    long long gate = place.gate + 2ll * t * p.n_lanes * p.width;
    read<T>(given.update, p.gates, gate);
    read<T>(given.candidate, p.gates, gate + p.width);
    given.reset = p.reset[(long long)t * p.n_lanes + place.lane];
}

struct MingruForward {
    static constexpr int N_GATES = 2;

    template <class T, int N>
    DEVICE void run(const MingruForwardParams& p, const Place& place) {
        float state[N];
        read<float>(state, p.start, place.unit);
        MingruGiven<N> given, next;
        load<T>(next, p, place, 0);
        for (int t = 0; t < p.n_steps; t++) {
            given = next;
            if (t + 1 < p.n_steps)
                load<T>(next, p, place, t + 1);
            if (given.reset)
                clear(state);
            for (int n = 0; n < N; n++)
                state[n] += sigmoid(given.update[n]) * (given.candidate[n] - state[n]);
            write<T>(p.outputs, place.unit + (long long)t * p.n_lanes * p.width, state);
        }
        write<float>(p.last, place.unit, state);
    }
};

// The step's state before it, and what the loss asks of its output.
template <int N>
struct MingruGivenBack {
    MingruGiven<N> forward;
    float before[N], d_output[N];
};

template <class T, int N>
DEVICE void load_back(MingruGivenBack<N>& given, const MingruBackwardParams& p, const Place& place,
                      int t) {
    long long rows = (long long)p.n_lanes * p.width, unit = place.unit + t * rows;
    load<T>(given.forward, p, place, t);
    read<T>(given.d_output, p.d_outputs, unit);
    if (t)
        read<T>(given.before, p.outputs, unit - rows);
    else
        read<float>(given.before, p.start, place.unit);
}

struct MingruBackward {
    static constexpr int N_GATES = 2;

    template <class T, int N>
    DEVICE void run(const MingruBackwardParams& p, const Place& place) {
        float d_state[N], d_update[N], d_candidate[N];
        read<float>(d_state, p.d_last, place.unit);
        MingruGivenBack<N> given, next;
        load_back<T>(next, p, place, p.n_steps - 1);
        for (int t = p.n_steps - 1; t >= 0; t--) {
            given = next;
            if (t)
                load_back<T>(next, p, place, t - 1);
            if (given.forward.reset)
                clear(given.before);
            for (int n = 0; n < N; n++) {
                float z = sigmoid(given.forward.update[n]), d = d_state[n] + given.d_output[n];
                d_candidate[n] = d * z;
                d_update[n] =
                    d_candidate[n] * (1.f - z) * (given.forward.candidate[n] - given.before[n]);
                d_state[n] = d * (1.f - z);
            }
            if (given.forward.reset)
                clear(d_state);
            long long gate = place.gate + 2ll * t * p.n_lanes * p.width;
            write<T>(p.d_gates, gate, d_update);
            write<T>(p.d_gates, gate + p.width, d_candidate);
        }
        write<float>(p.d_start, place.unit, d_state);
    }
};

KERNEL mingru_forward_float32(MingruForwardParams p) { run<MingruForward, float>(p); }
KERNEL mingru_forward_bfloat16(MingruForwardParams p) { run<MingruForward, Bfloat16>(p); }
KERNEL mingru_backward_float32(MingruBackwardParams p) { run<MingruBackward, float>(p); }
KERNEL mingru_backward_bfloat16(MingruBackwardParams p) { run<MingruBackward, Bfloat16>(p); }
