// The LSTM over a whole sequence, forward and backward, in one kernel each. The recurrent weights
// stay in registers from the first step to the last.
//
// A cluster of W / 64 blocks runs 32 lanes. A block computes the four gates of 64 units, with its
// share of the weights as the left matrix of each product and the lanes as columns of the right
// one. After a step the blocks of a cluster exchange, through each other's shared memory, the
// outputs of their units (forward), or their parts of the sums over all gates (backward, added in
// a fixed order).
//
// Of the 16 x 8 results of a product, a thread holds rows g and g + 8 and columns 2 q and 2 q + 1,
// with g = lane / 4 and q = lane % 4 of the warp. Rows are laid out so that these are the four gates
// of one unit. So gates and cells never leave their thread, and what the backward pass needs is
// saved in the order of the threads.
#include "constants.h"
#include "params.h"
#include "tensor_cores.h"

#define KERNEL extern "C" __global__ void
// Blocks of a cluster. One block per multiprocessor, which leaves a thread 255 registers.
#define BOUNDS(n_blocks) __cluster_dims__(n_blocks, 1, 1) __launch_bounds__(THREADS, 1)

constexpr int LANES = SEQUENCE_LANES, UNITS = BLOCK_UNITS, THREADS = SEQUENCE_THREADS;
constexpr int GATES = 4 * UNITS;  // of a block
constexpr int PAD = 8;            // elements after each row, so that rows start in other banks
constexpr int COLUMNS = LANES / 8;

typedef unsigned short Bits;  // of a bfloat16

extern __shared__ __align__(16) unsigned char shared_memory[];

// A thread's place: its unit in the block and its lanes 8 j + 2 q + {0, 1}, j = 0 to 3.
struct Thread {
    int index, warp, warp_lane, g, q, unit;
};

DEVICE Thread this_thread() {
    int i = threadIdx.x, lane = i & 31;
    return {i, i >> 5, lane, lane >> 2, lane & 3, 8 * (i >> 5) + (lane >> 2)};
}

// Adds the product of this warp's weights and the rows of `right`, one per lane, to `sums`.
template <int K>
DEVICE void multiply(float (&sums)[2][COLUMNS][4], const unsigned int (&left)[2][K / 16][4],
                     const Bits* right, const Thread& me) {
    const Bits* row = right + (8 * (me.warp_lane >> 4) + (me.warp_lane & 7)) * (K + PAD) +
                      8 * (me.warp_lane >> 3 & 1);
#pragma unroll
    for (int k = 0; k < K / 16; k++)
#pragma unroll
        for (int j = 0; j < COLUMNS; j += 2) {
            unsigned int b[4];
            load_matrices(b, row + 8 * j * (K + PAD) + 16 * k);
#pragma unroll
            for (int tile = 0; tile < 2; tile++) {
                multiply_add(sums[tile][j], left[tile][k], b[0], b[1]);
                multiply_add(sums[tile][j + 1], left[tile][k], b[2], b[3]);
            }
        }
}

// Where a thread's saved numbers of step t begin, in units of `n` words of 16 bytes per thread.
DEVICE long long saved_at(long long policy, int t, int n_steps, int cluster, int n_clusters,
                          int n_ranks, int rank, int n, int thread) {
    long long block = ((policy * n_steps + t) * n_clusters + cluster) * n_ranks + rank;
    return block * n * THREADS + thread;
}

// ---- Forward ----

template <int W>
struct ForwardMemory {
    Bits hidden[2][LANES][W + PAD];
    Bits gates[2][LANES][GATES + PAD];
    Bits output[LANES][UNITS + PAD];
};

template <int W>
DEVICE void lstm_forward(const LstmSequenceForwardParams& p) {
    constexpr int RANKS = W / UNITS;
    ForwardMemory<W>& memory = *(ForwardMemory<W>*)shared_memory;
    Thread me = this_thread();
    int rank = cluster_rank(), cluster = blockIdx.x / RANKS, first_lane = LANES * cluster;
    int n_lanes = p.n_lanes, last_lane = n_lanes - 1;
    long long policy = blockIdx.y, lanes = policy * n_lanes;
    int unit = rank * UNITS + me.unit;
    const Bits* gates = (const Bits*)p.gates + policy * p.n_steps * n_lanes * (4 * W);
    const unsigned char* reset = p.reset + policy * p.n_steps * n_lanes;
    Bits* outputs = (Bits*)p.outputs + policy * p.n_steps * n_lanes * W;
    Bits* hiddens = (Bits*)p.hiddens + policy * p.n_steps * n_lanes * W;

    // Rows of tile 0: input gates, then forget gates; of tile 1: candidates, then output gates
    unsigned int weights[2][W / 16][4];
    const Bits* weight = (const Bits*)p.weight + policy * (4 * W) * W;
#pragma unroll
    for (int tile = 0; tile < 2; tile++)
#pragma unroll
        for (int k = 0; k < W / 16; k++)
#pragma unroll
            for (int part = 0; part < 4; part++) {
                int gate = 2 * tile + (part & 1), column = 16 * k + 2 * me.q + 8 * (part >> 1);
                weights[tile][k][part] =
                    *(const unsigned int*)(weight + (gate * W + unit) * W + column);
            }

    // The input state of step 0. Every block needs all units of the outputs.
    for (int i = me.index; i < LANES * W / 2; i += THREADS) {
        int lane = i / (W / 2), column = 2 * (i % (W / 2));
        int from = min(first_lane + lane, last_lane);
        float2 pair = *(const float2*)(p.last_output + (lanes + from) * W + column);
        unsigned int bits = reset[from] ? 0u : pack_bfloat16(pair.x, pair.y);
        *(unsigned int*)&memory.hidden[0][lane][column] = bits;
        if (column / UNITS == rank && first_lane + lane < n_lanes)
            *(unsigned int*)(hiddens + (long long)from * W + column) = bits;
    }
    float cells[COLUMNS][2];
#pragma unroll
    for (int j = 0; j < COLUMNS; j++)
#pragma unroll
        for (int e = 0; e < 2; e++) {
            int lane = min(first_lane + 8 * j + 2 * me.q + e, last_lane);
            cells[j][e] = reset[lane] ? 0.f : p.last_cell[(lanes + lane) * W + unit];
        }

    auto begin_gates = [&](int t) {
#pragma unroll
        for (int n = 0; n < 4; n++) {
            int i = me.index + n * THREADS, lane = i >> 5, gate = i >> 3 & 3, part = 8 * (i & 7);
            long long row = (long long)t * n_lanes + min(first_lane + lane, last_lane);
            begin_copy(&memory.gates[t & 1][lane][gate * UNITS + part],
                       gates + row * (4 * W) + gate * W + rank * UNITS + part);
        }
    };
    begin_gates(0);
    wait_for_copies();
    cluster_barrier();

    for (int t = 0; t < p.n_steps; t++) {
        bool is_last = t + 1 == p.n_steps;
        unsigned int next_resets = 0;  // bit 2 j + e: whether the lane is reset before step t + 1
        if (!is_last) {
            begin_gates(t + 1);
#pragma unroll
            for (int j = 0; j < COLUMNS; j++)
#pragma unroll
                for (int e = 0; e < 2; e++) {
                    int lane = min(first_lane + 8 * j + 2 * me.q + e, last_lane);
                    bool is_reset = reset[(long long)(t + 1) * n_lanes + lane];
                    next_resets |= (unsigned int)is_reset << (2 * j + e);
                }
        }
        float sums[2][COLUMNS][4];
#pragma unroll
        for (int tile = 0; tile < 2; tile++)
#pragma unroll
            for (int j = 0; j < COLUMNS; j++)
#pragma unroll
                for (int part = 0; part < 4; part++) {
                    int gate = 2 * tile + (part >> 1), lane = 8 * j + 2 * me.q + (part & 1);
                    Bits bits = memory.gates[t & 1][lane][gate * UNITS + me.unit];
                    sums[tile][j][part] = __uint_as_float((unsigned int)bits << 16);
                }
        multiply<W>(sums, weights, &memory.hidden[t & 1][0][0], me);

        unsigned int rounded[2][COLUMNS][2];  // input | forget, candidate | output
#pragma unroll
        for (int j = 0; j < COLUMNS; j++)
#pragma unroll
            for (int e = 0; e < 2; e++) {
                rounded[0][j][e] = pack_bfloat16(sums[0][j][e], sums[0][j][2 + e]);
                rounded[1][j][e] = pack_bfloat16(sums[1][j][e], sums[1][j][2 + e]);
            }
        if (p.saved_gates) {
            uint4* saved = (uint4*)p.saved_gates + saved_at(policy, t, p.n_steps, cluster,
                                                            p.n_clusters, RANKS, rank, 4, me.index);
#pragma unroll
            for (int j = 0; j < COLUMNS; j++)
                saved[j * THREADS] = {rounded[0][j][0], rounded[1][j][0], rounded[0][j][1],
                                      rounded[1][j][1]};
            float4* saved_cells =
                (float4*)p.saved_cells +
                saved_at(policy, t, p.n_steps, cluster, p.n_clusters, RANKS, rank, 2, me.index);
            saved_cells[0] = {cells[0][0], cells[0][1], cells[1][0], cells[1][1]};
            saved_cells[THREADS] = {cells[2][0], cells[2][1], cells[3][0], cells[3][1]};
        }
#pragma unroll
        for (int j = 0; j < COLUMNS; j++)
#pragma unroll
            for (int e = 0; e < 2; e++) {
                float input = sigmoid(low_half(rounded[0][j][e]));
                float forget = sigmoid(high_half(rounded[0][j][e]));
                float candidate = tanh_of(low_half(rounded[1][j][e]));
                float output = sigmoid(high_half(rounded[1][j][e]));
                float after = forget * cells[j][e] + input * candidate;
                float value = output * tanh_of(after);
                int lane = 8 * j + 2 * me.q + e;
                memory.output[lane][me.unit] = (Bits)pack_bfloat16(value, 0.f);
                cells[j][e] = next_resets >> (2 * j + e) & 1 ? 0.f : after;
            }
        __syncthreads();
        int lane = me.index >> 3, part = 8 * (me.index & 7);
        uint4 value = *(const uint4*)&memory.output[lane][part];
        bool exists = first_lane + lane < n_lanes;
        long long row = (long long)t * n_lanes + first_lane + lane, column = rank * UNITS + part;
        if (exists)
            *(uint4*)(outputs + row * W + column) = value;
        if (!is_last) {
            if (exists && reset[row + n_lanes])
                value = {0, 0, 0, 0};
            if (exists)
                *(uint4*)(hiddens + (row + n_lanes) * W + column) = value;
            const Bits* target = &memory.hidden[(t + 1) & 1][lane][column];
#pragma unroll
            for (int other = 0; other < RANKS; other++)
                write_there(address_in(target, other), value);
        }
        wait_for_copies();
        cluster_barrier();
    }
#pragma unroll
    for (int j = 0; j < COLUMNS; j++)
#pragma unroll
        for (int e = 0; e < 2; e++) {
            int lane = first_lane + 8 * j + 2 * me.q + e;
            if (lane < n_lanes)
                p.cell[(lanes + lane) * W + unit] = cells[j][e];
        }
}

// ---- Backward ----

template <int W>
struct BackwardMemory {
    static constexpr int RANKS = W / UNITS;
    float parts[2][RANKS][UNITS][LANES + PAD];  // by the block that they come from
    Bits d_gates[LANES][GATES + PAD];
    Bits d_output[2][LANES][UNITS + PAD];
};

template <int W>
DEVICE void lstm_backward(const LstmSequenceBackwardParams& p) {
    constexpr int RANKS = W / UNITS;
    constexpr int TILES = W / 128;  // of 16 units, per warp
    static_assert(TILES == 2, "a warp multiplies two tiles");
    BackwardMemory<W>& memory = *(BackwardMemory<W>*)shared_memory;
    Thread me = this_thread();
    int rank = cluster_rank(), cluster = blockIdx.x / RANKS, first_lane = LANES * cluster;
    int n_lanes = p.n_lanes, last_lane = n_lanes - 1;
    long long policy = blockIdx.y, lanes = policy * n_lanes;
    int unit = rank * UNITS + me.unit;
    const unsigned char* reset = p.reset + policy * p.n_steps * n_lanes;
    const Bits* d_outputs = (const Bits*)p.d_outputs + policy * p.n_steps * n_lanes * W;
    Bits* d_gates = (Bits*)p.d_gates + policy * p.n_steps * n_lanes * (4 * W);

    // Rows: the units whose outputs fed the gates, 32 per warp. Columns: this block's gates.
    unsigned int weights[2][GATES / 16][4];
    const Bits* weight = (const Bits*)p.weight + policy * W * (4 * W);
#pragma unroll
    for (int tile = 0; tile < 2; tile++)
#pragma unroll
        for (int k = 0; k < GATES / 16; k++)
#pragma unroll
            for (int part = 0; part < 4; part++) {
                int row = 32 * me.warp + 16 * tile + me.g + 8 * (part & 1);
                int i = 16 * k + 2 * me.q + 8 * (part >> 1), gate = i / UNITS;
                weights[tile][k][part] =
                    *(const unsigned int*)(weight + row * (4 * W) + gate * W + rank * UNITS +
                                           i % UNITS);
            }

    float d_cells[COLUMNS][2], d_bias[4] = {0.f, 0.f, 0.f, 0.f};
#pragma unroll
    for (int j = 0; j < COLUMNS; j++)
#pragma unroll
        for (int e = 0; e < 2; e++) {
            int lane = first_lane + 8 * j + 2 * me.q + e;
            d_cells[j][e] = lane < n_lanes ? p.d_cell[(lanes + lane) * W + unit] : 0.f;
        }

    auto begin_d_output = [&](int t) {
        int lane = me.index >> 3, part = 8 * (me.index & 7);
        long long row = (long long)t * n_lanes + min(first_lane + lane, last_lane);
        begin_copy(&memory.d_output[t & 1][lane][part], d_outputs + row * W + rank * UNITS + part);
    };
    begin_d_output(p.n_steps - 1);
    wait_for_copies();
    cluster_barrier();

    // The gradient of each lane's recurrent input of the step after t
    float d_hiddens[COLUMNS][2];
    auto add_parts = [&](int t) {
#pragma unroll
        for (int j = 0; j < COLUMNS; j++) {
            d_hiddens[j][0] = d_hiddens[j][1] = 0.f;
#pragma unroll
            for (int other = 0; other < RANKS; other++) {
                float2 pair =
                    *(const float2*)&memory.parts[t & 1][other][me.unit][8 * j + 2 * me.q];
                d_hiddens[j][0] += pair.x;
                d_hiddens[j][1] += pair.y;
            }
        }
    };
    auto is_reset = [&](int t, int j, int e) {
        int lane = min(first_lane + 8 * j + 2 * me.q + e, last_lane);
        return reset[(long long)t * n_lanes + lane] != 0;
    };

    for (int t = p.n_steps - 1; t >= 0; t--) {
        const uint4* saved = (const uint4*)p.saved_gates + saved_at(policy, t, p.n_steps, cluster,
                                                                    p.n_clusters, RANKS, rank, 4,
                                                                    me.index);
        const float4* saved_cells =
            (const float4*)p.saved_cells +
            saved_at(policy, t, p.n_steps, cluster, p.n_clusters, RANKS, rank, 2, me.index);
        uint4 gates[COLUMNS];
        float4 cells[COLUMNS / 2];
#pragma unroll
        for (int j = 0; j < COLUMNS; j++)
            gates[j] = saved[j * THREADS];
        cells[0] = saved_cells[0];
        cells[1] = saved_cells[THREADS];
        if (t)
            begin_d_output(t - 1);
        bool has_next = t + 1 < p.n_steps;
        if (has_next)
            add_parts(t + 1);
#pragma unroll
        for (int j = 0; j < COLUMNS; j++)
#pragma unroll
            for (int e = 0; e < 2; e++) {
                int lane = 8 * j + 2 * me.q + e;
                unsigned int first = e ? gates[j].z : gates[j].x;
                unsigned int second = e ? gates[j].w : gates[j].y;
                float4 four = cells[j / 2];
                float before = j & 1 ? (e ? four.w : four.z) : (e ? four.y : four.x);
                float input = sigmoid(low_half(first)), forget = sigmoid(high_half(first));
                float candidate = tanh_of(low_half(second)), output = sigmoid(high_half(second));
                float after = tanh_of(forget * before + input * candidate);
                Bits bits = memory.d_output[t & 1][lane][me.unit];
                float d_output = __uint_as_float((unsigned int)bits << 16);
                float d_cell = d_cells[j][e];
                if (has_next) {
                    bool cut = is_reset(t + 1, j, e);
                    d_output += cut ? 0.f : d_hiddens[j][e];
                    d_cell = cut ? 0.f : d_cell;
                }
                d_cell += d_output * output * (1.f - after * after);
                unsigned int d_first =
                    pack_bfloat16(d_cell * candidate * input * (1.f - input),
                                  d_cell * before * forget * (1.f - forget));
                unsigned int d_second =
                    pack_bfloat16(d_cell * input * (1.f - candidate * candidate),
                                  d_output * after * output * (1.f - output));
                d_cells[j][e] = d_cell * forget;
                if (first_lane + lane >= n_lanes)
                    d_first = d_second = 0u;
                d_bias[0] += low_half(d_first);
                d_bias[1] += high_half(d_first);
                d_bias[2] += low_half(d_second);
                d_bias[3] += high_half(d_second);
                Bits* row = &memory.d_gates[lane][me.unit];
                row[0] = (Bits)d_first;
                row[UNITS] = (Bits)(d_first >> 16);
                row[2 * UNITS] = (Bits)d_second;
                row[3 * UNITS] = (Bits)(d_second >> 16);
            }
        __syncthreads();
#pragma unroll
        for (int n = 0; n < 4; n++) {
            int i = me.index + n * THREADS, lane = i >> 5, gate = i >> 3 & 3, part = 8 * (i & 7);
            long long row = (long long)t * n_lanes + first_lane + lane;
            if (first_lane + lane < n_lanes)
                *(uint4*)(d_gates + row * (4 * W) + gate * W + rank * UNITS + part) =
                    *(const uint4*)&memory.d_gates[lane][gate * UNITS + part];
        }
        float sums[2][COLUMNS][4] = {};
        multiply<GATES>(sums, weights, &memory.d_gates[0][0], me);
#pragma unroll
        for (int tile = 0; tile < 2; tile++)
#pragma unroll
            for (int half = 0; half < 2; half++) {
                int row = 32 * me.warp + 16 * tile + me.g + 8 * half;
                unsigned int target = address_in(
                    &memory.parts[t & 1][rank][row % UNITS][2 * me.q], row / UNITS);
#pragma unroll
                for (int j = 0; j < COLUMNS; j++)
                    write_there(target + 8 * j * (int)sizeof(float), sums[tile][j][2 * half],
                                sums[tile][j][2 * half + 1]);
            }
        wait_for_copies();
        cluster_barrier();
    }
    add_parts(0);
#pragma unroll
    for (int j = 0; j < COLUMNS; j++)
#pragma unroll
        for (int e = 0; e < 2; e++) {
            int lane = first_lane + 8 * j + 2 * me.q + e;
            if (lane < n_lanes) {
                bool cut = is_reset(0, j, e);
                p.d_last_output[(lanes + lane) * W + unit] = cut ? 0.f : d_hiddens[j][e];
                p.d_last_cell[(lanes + lane) * W + unit] = cut ? 0.f : d_cells[j][e];
            }
        }
#pragma unroll
    for (int gate = 0; gate < 4; gate++) {
        float sum = d_bias[gate];
        sum += __shfl_xor_sync(~0u, sum, 1);
        sum += __shfl_xor_sync(~0u, sum, 2);
        if (!me.q)
            p.d_bias[(policy * p.n_clusters + cluster) * (4 * W) + gate * W + unit] = sum;
    }
}

static_assert(sizeof(ForwardMemory<256>) == FORWARD_MEMORY);
static_assert(sizeof(BackwardMemory<256>) == BACKWARD_MEMORY);

KERNEL BOUNDS(4) lstm_sequence_forward_256(LstmSequenceForwardParams p) {
    lstm_forward<256>(p);
}
KERNEL BOUNDS(4) lstm_sequence_backward_256(LstmSequenceBackwardParams p) {
    lstm_backward<256>(p);
}
