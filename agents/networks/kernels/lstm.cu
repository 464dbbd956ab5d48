// What the LSTM does to a step between two matrix products, in float32. One thread per lane and
// n_units neighbouring units.
//
// The gates stay as the product left them, and the backward step activates them once more: in
// bfloat16 a gate of 0.99 is known to 0.002, so its slope, which holds 1 - 0.99, would be lost.
#include "lanes.h"
#include "params.h"

// The activated gates of N units, the cell before and after the step, and the latter squashed.
template <int N>
struct LstmStep {
    float input[N], forget[N], candidate[N], output[N], before[N], after[N], squashed[N];
};

template <class T, int N, class Params>
DEVICE void activate(LstmStep<N>& s, const Params& p, const Place& place) {
    read<T>(s.input, p.gates, place.gate);
    read<T>(s.forget, p.gates, place.gate + p.width);
    read<T>(s.candidate, p.gates, place.gate + 2 * p.width);
    read<T>(s.output, p.gates, place.gate + 3 * p.width);
    read<float>(s.before, p.cell, place.unit);
    for (int n = 0; n < N; n++) {
        s.input[n] = sigmoid(s.input[n]);
        s.forget[n] = sigmoid(s.forget[n]);
        s.candidate[n] = tanh_of(s.candidate[n]);
        s.output[n] = sigmoid(s.output[n]);
        s.after[n] = s.forget[n] * s.before[n] + s.input[n] * s.candidate[n];
        s.squashed[n] = tanh_of(s.after[n]);
    }
}

struct LstmStart {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmStartParams& p, const Place& place) {
        float memory[N], cell[N];
        read<float>(memory, p.last_output, place.unit);
        read<float>(cell, p.last_cell, place.unit);
        if (p.reset[place.lane]) {
            clear(memory);
            clear(cell);
        }
        write<T>(p.memory, place.unit, memory);
        write<float>(p.cell, place.unit, cell);
    }
};

struct LstmForward {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmForwardParams& p, const Place& place) {
        bool forgotten = p.next_reset && p.next_reset[place.lane];
        LstmStep<N> s;
        activate<T>(s, p, place);
        float output[N];
        for (int n = 0; n < N; n++)
            output[n] = s.output[n] * s.squashed[n];
        write<T>(p.output, place.unit, output);
        if (forgotten) {
            clear(output);
            clear(s.after);
        }
        if (p.next_memory)
            write<T>(p.next_memory, place.unit, output);
        write<float>(p.next_cell, place.unit, s.after);
    }
};

struct LstmBackward {
    static constexpr int N_GATES = 4;

    template <class T, int N>
    DEVICE void run(const LstmBackwardParams& p, const Place& place) {
        float d_output[N], d_memory[N], d_after[N];
        read<T>(d_output, p.d_output, place.unit);
        read<float>(d_after, p.d_next_cell, place.unit);
        clear(d_memory);
        bool forgotten = false;
        if (p.d_next_memory) {  // whether forgotten or not: no load waits for another
            read<T>(d_memory, p.d_next_memory, place.unit);
            forgotten = p.next_reset[place.lane];
        }
        LstmStep<N> s;
        activate<T>(s, p, place);
        if (forgotten) {
            clear(d_memory);
            clear(d_after);
        }
        for (int n = 0; n < N; n++) {
            float i = s.input[n], f = s.forget[n], g = s.candidate[n], o = s.output[n];
            float d_h = d_output[n] + d_memory[n];
            float d_cell = d_after[n] + d_h * o * (1.f - s.squashed[n] * s.squashed[n]);
            s.input[n] = d_cell * g * i * (1.f - i);
            s.forget[n] = d_cell * s.before[n] * f * (1.f - f);
            s.candidate[n] = d_cell * i * (1.f - g * g);
            s.output[n] = d_h * s.squashed[n] * o * (1.f - o);
            d_after[n] = d_cell * f;
        }
        write<T>(p.d_gates, place.gate, s.input);
        write<T>(p.d_gates, place.gate + p.width, s.forget);
        write<T>(p.d_gates, place.gate + 2 * p.width, s.candidate);
        write<T>(p.d_gates, place.gate + 3 * p.width, s.output);
        write<float>(p.d_cell, place.unit, d_after);
    }
};

KERNEL lstm_start_float32(LstmStartParams p) { run<LstmStart, float>(p); }
KERNEL lstm_start_bfloat16(LstmStartParams p) { run<LstmStart, Bfloat16>(p); }
KERNEL lstm_forward_float32(LstmForwardParams p) { run<LstmForward, float>(p); }
KERNEL lstm_forward_bfloat16(LstmForwardParams p) { run<LstmForward, Bfloat16>(p); }
KERNEL lstm_backward_float32(LstmBackwardParams p) { run<LstmBackward, float>(p); }
KERNEL lstm_backward_bfloat16(LstmBackwardParams p) { run<LstmBackward, Bfloat16>(p); }
