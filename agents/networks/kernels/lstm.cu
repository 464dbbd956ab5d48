// The LSTM's element-wise work between two matrix products, in float32. One thread per lane and
// n_units neighbouring units.
//
// Gates are stored before activation, and the backward step activates them again. Stored after it,
// in bfloat16, a gate of 0.99 would have an error of 0.002 and its slope, 0.99 (1 - 0.99), would be
// lost.
#include "lanes.h"
#include "params.h"

// The activated gates of N units, the cell before and after the step, and tanh of the latter.
template <int N>
struct LstmStep {
    float input[N], forget[N], candidate[N], output[N], before[N], after[N], tanh_after[N];
};

// Computes a step whose cell `s.before` is set.
template <class T, int N, class Params>
DEVICE void activate(LstmStep<N>& s, const Params& p, const UnitIndex& index) {
    read<T>(s.input, p.gates, index.gate);
    read<T>(s.forget, p.gates, index.gate + p.width);
    read<T>(s.candidate, p.gates, index.gate + 2 * p.width);
    read<T>(s.output, p.gates, index.gate + 3 * p.width);
    for (int n = 0; n < N; n++) {
        s.input[n] = sigmoid(s.input[n]);
        s.forget[n] = sigmoid(s.forget[n]);
        s.candidate[n] = tanh_of(s.candidate[n]);
        s.output[n] = sigmoid(s.output[n]);
        s.after[n] = s.forget[n] * s.before[n] + s.input[n] * s.candidate[n];
        s.tanh_after[n] = tanh_of(s.after[n]);
    }
}

// What a step multiplies by its weights: a row has the inputs, then the last outputs.
struct LstmJoin {
    static constexpr int N_GATES = 2;

    template <class T, int N>
    DEVICE void run(const LstmJoinParams& p, const UnitIndex& index) {
        float x[N], hidden[N];
        read<T>(x, p.x, index.unit);
        read<float>(hidden, p.last_output, index.unit);
        if (p.reset[index.lane])
            clear(hidden);
        write<T>(p.joined, index.gate, x);
        write<T>(p.joined, index.gate + p.width, hidden);
    }
};

// One step without a gradient.
struct LstmAct {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmActParams& p, const UnitIndex& index) {
        LstmStep<N> s;
        read<float>(s.before, p.last_cell, index.unit);
        if (p.reset[index.lane])
            clear(s.before);
        activate<T>(s, p, index);
        T output[N];
        float next_output[N];
        for (int n = 0; n < N; n++) {
            assign(output[n], s.output[n] * s.tanh_after[n]);
            next_output[n] = to_float(output[n]);
        }
        write<float>(p.next_output, index.unit, next_output);
        if (p.residual) {
            float residual[N];
            read<T>(residual, p.residual, index.unit);
            for (int n = 0; n < N; n++)
                next_output[n] += residual[n];
        }
        write<T>(p.output, index.unit, next_output);
        write<float>(p.next_cell, index.unit, s.after);
    }
};

struct LstmForward {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmForwardParams& p, const UnitIndex& index) {
        bool next_resets = p.next_reset && p.next_reset[index.lane];
        LstmStep<N> s;
        read<float>(s.before, p.cell, index.unit);
        activate<T>(s, p, index);
        float output[N];
        for (int n = 0; n < N; n++)
            output[n] = s.output[n] * s.tanh_after[n];
        write<T>(p.output, index.unit, output);
        if (next_resets) {
            clear(output);
            clear(s.after);
        }
        if (p.next_hidden)
            write<T>(p.next_hidden, index.unit, output);
        write<float>(p.next_cell, index.unit, s.after);
    }
};

struct LstmBackward {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmBackwardParams& p, const UnitIndex& index) {
        float d_output[N], d_hidden[N], d_after[N];
        read<T>(d_output, p.d_output, index.unit);
        read<float>(d_after, p.d_next_cell, index.unit);
        clear(d_hidden);
        bool next_resets = false;
        if (p.d_next_hidden) {  // even if the next step resets: no load waits for another
            read<T>(d_hidden, p.d_next_hidden, index.unit);
            next_resets = p.next_reset[index.lane];
        }
        LstmStep<N> s;
        read<float>(s.before, p.cell, index.unit);
        activate<T>(s, p, index);
        if (next_resets) {
            clear(d_hidden);
            clear(d_after);
        }
        for (int n = 0; n < N; n++) {
            float i = s.input[n], f = s.forget[n], g = s.candidate[n], o = s.output[n];
            float d_h = d_output[n] + d_hidden[n];
            float d_cell = d_after[n] + d_h * o * (1.f - s.tanh_after[n] * s.tanh_after[n]);
            s.input[n] = d_cell * g * i * (1.f - i);
            s.forget[n] = d_cell * s.before[n] * f * (1.f - f);
            s.candidate[n] = d_cell * i * (1.f - g * g);
            s.output[n] = d_h * s.tanh_after[n] * o * (1.f - o);
            d_after[n] = d_cell * f;
        }
        write<T>(p.d_gates, index.gate, s.input);
        write<T>(p.d_gates, index.gate + p.width, s.forget);
        write<T>(p.d_gates, index.gate + 2 * p.width, s.candidate);
        write<T>(p.d_gates, index.gate + 3 * p.width, s.output);
        write<float>(p.d_cell, index.unit, d_after);
    }
};

INSTANCE(BOUNDS(64) lstm_join_float32, LstmJoinParams, run<LstmJoin, float>)
INSTANCE(BOUNDS(64) lstm_join_bfloat16, LstmJoinParams, run<LstmJoin, Bfloat16>)
INSTANCE(BOUNDS(64) lstm_act_float32, LstmActParams, run<LstmAct, float>)
INSTANCE(BOUNDS(64) lstm_act_bfloat16, LstmActParams, run<LstmAct, Bfloat16>)
INSTANCE(BOUNDS(64) lstm_forward_float32, LstmForwardParams, run<LstmForward, float>)
INSTANCE(BOUNDS(64) lstm_forward_bfloat16, LstmForwardParams, run<LstmForward, Bfloat16>)
INSTANCE(BOUNDS(64) lstm_backward_float32, LstmBackwardParams, run<LstmBackward, float>)
INSTANCE(BOUNDS(64) lstm_backward_bfloat16, LstmBackwardParams, run<LstmBackward, Bfloat16>)
