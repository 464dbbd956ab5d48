// The element-wise work of the LSTM's step around one matrix product, in float32, when acting. One
// thread per lane and n_units neighbouring units.
#include "lanes.h"
#include "params.h"

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
        float input[N], forget[N], candidate[N], gate[N], cell[N], next_output[N];
        read<float>(cell, p.last_cell, index.unit);
        if (p.reset[index.lane])
            clear(cell);
        read<T>(input, p.gates, index.gate);
        read<T>(forget, p.gates, index.gate + p.width);
        read<T>(candidate, p.gates, index.gate + 2 * p.width);
        read<T>(gate, p.gates, index.gate + 3 * p.width);
        for (int n = 0; n < N; n++) {
            cell[n] = sigmoid(forget[n]) * cell[n] + sigmoid(input[n]) * tanh_of(candidate[n]);
            T output;
            assign(output, sigmoid(gate[n]) * tanh_of(cell[n]));
            next_output[n] = to_float(output);
        }
        write<float>(p.next_output, index.unit, next_output);
        if (p.residual) {
            float residual[N];
            read<T>(residual, p.residual, index.unit);
            for (int n = 0; n < N; n++)
                next_output[n] += residual[n];
        }
        write<T>(p.output, index.unit, next_output);
        write<float>(p.next_cell, index.unit, cell);
    }
};

INSTANCE(BOUNDS(64) lstm_join_float32, LstmJoinParams, run<LstmJoin, float>)
INSTANCE(BOUNDS(64) lstm_join_bfloat16, LstmJoinParams, run<LstmJoin, Bfloat16>)
INSTANCE(BOUNDS(64) lstm_act_float32, LstmActParams, run<LstmAct, float>)
INSTANCE(BOUNDS(64) lstm_act_bfloat16, LstmActParams, run<LstmAct, Bfloat16>)
