// The LSTM over a whole sequence, forward and backward, in one kernel each. The recurrent weights
// stay in registers from the first step to the last.
//
// A cluster of W / 64 blocks runs 40 lanes. A block computes the four gates of 64 units, with its
// share of the weights as the left matrix of each product and the lanes as columns of the right
// one. After a step the blocks of a cluster send each other, from shared memory to shared memory,
// the outputs of their units (forward), or their parts of the sums over all gates (backward, added
// in a fixed order). A block sends what step t + 1 needs only after all have sent what step t
// needed, so two buffers are enough.
//
// Of the 16 x 8 results of a product, a thread holds rows g and g + 8 and columns 2 q and 2 q + 1,
// with g = lane / 4 and q = lane % 4 of the warp. Rows are laid out so that these are the four
// gates of one unit. So gates and cells never leave their thread, and what the backward pass needs
// is saved in the order of the threads.
#include "common/tensor_cores.h"
#include "params.h"

// Blocks of a cluster. One block per multiprocessor, which leaves a thread 255 registers.
#define BOUNDS(n_blocks) __cluster_dims__(n_blocks, 1, 1) __launch_bounds__(THREADS, 1)

constexpr int LANES = SEQUENCE_LANES, UNITS = BLOCK_UNITS, THREADS = SEQUENCE_THREADS;
constexpr int GATES = 4 * UNITS;    // of a block
constexpr int PAD = 8;              // elements after each row, so that rows start in other banks
constexpr int COLUMNS = LANES / 8;  // of eight lanes

// The lanes are run in two groups: while the blocks exchange one group's numbers, they compute the
// other's.
template <int group>
struct Group {
    static constexpr int NUMBER = group, COLUMNS = group ? 2 : 3, FIRST_COLUMN = group ? 3 : 0;
    static constexpr int LANES = 8 * COLUMNS, FIRST_LANE = 8 * FIRST_COLUMN;
};
static_assert(Group<0>::COLUMNS + Group<1>::COLUMNS == COLUMNS);

extern __shared__ __align__(16) unsigned char shared_memory[];

// A thread's place: its unit in the block, and its lanes 8 j + 2 q + {0, 1} of column j.
struct Thread {
    int index, warp, warp_lane, g, q, unit;
};

DEVICE Thread this_thread() {
    int i = threadIdx.x, lane = i & 31;
    return {i, i >> 5, lane, lane >> 2, lane & 3, 8 * (i >> 5) + (lane >> 2)};
}

// Loads the right matrix of one step of a product, 16 numbers of each lane: for each column of
// lanes two parts. `row` is this thread's row of the first two columns.
template <int C>
DEVICE void load_columns(unsigned int (&parts)[C][2], const Bits* row, int lanes_apart) {
    for (int j = 0; j + 1 < C; j += 2)
        load_matrices(parts[j], parts[j + 1], row + j * lanes_apart);
    if (C % 2)
        load_matrices(parts[C - 1], row + (C - 1) * lanes_apart);
}

// Adds the product of this warp's weights and of `right` to `sums`. `right` has a row of K numbers
// per lane, in pieces of N numbers; `piece` numbers lie between two pieces of a row.
template <int K, int N, int TILES, int C>
DEVICE void multiply(float (&sums)[TILES][C][4], const unsigned int (&left)[TILES][K / 16][4],
                     const Bits* right, int piece, const Thread& me) {
    const Bits* row = right + (8 * (me.warp_lane >> 4) + (me.warp_lane & 7)) * (N + PAD) +
                      8 * (me.warp_lane >> 3 & 1);
    unsigned int parts[2][C][2];  // of this step of the product and of the next
    load_columns(parts[0], row, 8 * (N + PAD));
    for (int k = 0; k < K / 16; k++) {
        int next = 16 * (k + 1);
        if (next < K)
            load_columns(parts[(k + 1) & 1], row + next / N * piece + next % N, 8 * (N + PAD));
        for (int tile = 0; tile < TILES; tile++)
            for (int j = 0; j < C; j++)
                multiply_add(sums[tile][j], left[tile][k], parts[k & 1][j][0], parts[k & 1][j][1]);
    }
}

// The number of the block whose saved numbers of step t these are.
DEVICE long long saved_block(int t, int cluster, int n_clusters, int n_ranks, int rank) {
    return ((long long)t * n_clusters + cluster) * n_ranks + rank;
}

// One bit per lane of the cluster, for each step: whether the lane is reset before it.
typedef unsigned long long Resets;

DEVICE void read_resets(Resets* words, const unsigned char* reset, int n_steps, int n_lanes,
                        int first_lane, const Thread& me) {
    for (int t = me.warp; t < n_steps; t += THREADS / 32) {
        Resets word = 0;
        for (int first = 0; first < LANES; first += 32) {
            int lane = min(first_lane + first + me.warp_lane, n_lanes - 1);
            word |= (Resets)__ballot_sync(~0u, reset[(long long)t * n_lanes + lane]) << first;
        }
        if (!me.warp_lane)
            words[t] = word;
    }
}

DEVICE unsigned int add(unsigned int a, unsigned int b) {
    return pack_bfloat16(low_half(a) + low_half(b), high_half(a) + high_half(b));
}

DEVICE uint4 add(uint4 a, uint4 b) {
    return {add(a.x, b.x), add(a.y, b.y), add(a.z, b.z), add(a.w, b.w)};
}

DEVICE void write_floats(float* target, uint4 bits) {
    ((float4*)target)[0] = {low_half(bits.x), high_half(bits.x), low_half(bits.y),
                            high_half(bits.y)};
    ((float4*)target)[1] = {low_half(bits.z), high_half(bits.z), low_half(bits.w),
                            high_half(bits.w)};
}

// Announces what comes of even and odd steps, of both groups, in bytes.
DEVICE void init_arrivals(Arrivals (&arrivals)[2][2], int first_bytes, int second_bytes) {
    for (int i = 0; i < 2; i++) {
        init(&arrivals[i][0]);
        expect(&arrivals[i][0], first_bytes);
        init(&arrivals[i][1]);
        expect(&arrivals[i][1], second_bytes);
    }
}

// ---- Forward ----

constexpr int STAGES = 3;  // steps whose gates are in shared memory
// One more than for gates: residuals are read after a step's last barrier, so slow warps still read
// those of step t - 1 when the copies for step t + 2 begin.
constexpr int RESIDUAL_STAGES = 4;

template <int W>
struct ForwardMemory {
    static constexpr int RANKS = W / UNITS;
    Bits hidden[2][RANKS][LANES][UNITS + PAD];  // by the block that sends it
    Bits next_hidden[2][LANES][UNITS + PAD];    // to send
    Bits output[2][LANES][UNITS + PAD];
    Bits gates[STAGES][LANES][GATES + PAD];
    Bits residual[RESIDUAL_STAGES][LANES][UNITS + PAD];
    Arrivals arrivals[2][2];  // of even and odd steps, of both groups
    Resets resets[MAX_STEPS];
};

template <int W>
DEVICE void lstm_forward(const LstmSequenceForwardParams& p) {
    constexpr int RANKS = W / UNITS;
    constexpr int SENT = (UNITS + PAD) * (int)sizeof(Bits);  // by a block, per lane
    ForwardMemory<W>& memory = *(ForwardMemory<W>*)shared_memory;
    Thread me = this_thread();
    int rank = cluster_rank(), cluster = blockIdx.x / RANKS, first_lane = LANES * cluster;
    int n_steps = p.n_steps, n_lanes = p.n_lanes, last_lane = n_lanes - 1;
    int unit = rank * UNITS + me.unit;
    const Bits* gates = (const Bits*)p.gates;
    const unsigned char* reset = p.reset;
    const Bits* residual = (const Bits*)p.residual;
    Bits* outputs = (Bits*)p.outputs;
    Bits* hiddens = (Bits*)p.hiddens;

    auto begin_gates = [&](int t) {
        if (t < n_steps) {
            for (int n = 0; n < LANES * GATES / 8 / THREADS; n++) {
                int i = me.index + n * THREADS, lane = i >> 5, gate = i >> 3 & 3;
                int part = 8 * (i & 7);
                long long row = (long long)t * n_lanes + min(first_lane + lane, last_lane);
                begin_copy(&memory.gates[t % STAGES][lane][gate * UNITS + part],
                           gates + row * (4 * W) + gate * W + rank * UNITS + part);
            }
            if (residual)
                for (int i = me.index; i < LANES * UNITS / 8; i += THREADS) {
                    int lane = i >> 3, part = 8 * (i & 7);
                    long long row = (long long)t * n_lanes + min(first_lane + lane, last_lane);
                    begin_copy(&memory.residual[t % RESIDUAL_STAGES][lane][part],
                               residual + row * W + rank * UNITS + part);
                }
        }
        end_group();
    };
    begin_gates(0);
    begin_gates(1);

    // Rows of tile 0: input gates, then forget gates; of tile 1: candidates, then output gates
    unsigned int weights[2][W / 16][4];
    const Bits* weight = (const Bits*)p.weight;
#pragma unroll
    for (int tile = 0; tile < 2; tile++)
        for (int k = 0; k < W / 16; k++)
            for (int part = 0; part < 4; part++) {
                int gate = 2 * tile + (part & 1), column = 16 * k + 2 * me.q + 8 * (part >> 1);
                weights[tile][k][part] =
                    *(const unsigned int*)(weight + (gate * W + unit) * W + column);
            }

    // The input state of step 0. Every block needs all units of the outputs.
    for (int i = me.index; i < LANES * W / 2; i += THREADS) {
        int lane = i / (W / 2), column = 2 * (i % (W / 2));
        int from = min(first_lane + lane, last_lane);
        float2 pair = *(const float2*)(p.last_output + (long long)from * W + column);
        unsigned int bits = reset[from] ? 0u : pack_bfloat16(pair.x, pair.y);
        *(unsigned int*)&memory.hidden[0][column / UNITS][lane][column % UNITS] = bits;
        if (column / UNITS == rank && first_lane + lane < n_lanes)
            *(unsigned int*)(hiddens + (long long)from * W + column) = bits;
    }
    float cells[COLUMNS][2];
    for (int j = 0; j < COLUMNS; j++)
        for (int e = 0; e < 2; e++) {
            int lane = min(first_lane + 8 * j + 2 * me.q + e, last_lane);
            cells[j][e] = reset[lane] ? 0.f : p.last_cell[(long long)lane * W + unit];
        }
    read_resets(memory.resets, reset, n_steps, n_lanes, first_lane, me);
    if (!me.index)
        init_arrivals(memory.arrivals, RANKS * SENT * Group<0>::LANES,
                      RANKS * SENT * Group<1>::LANES);
    wait_for_copies<1>();
    cluster_barrier();

    auto run = [&](int t, auto group) {
        typedef decltype(group) G;
        constexpr int C = G::COLUMNS;
        bool is_last = t + 1 == n_steps;
        Resets resets = is_last ? 0 : memory.resets[t + 1] >> (2 * me.q);
        float sums[2][C][4];
        for (int tile = 0; tile < 2; tile++)
            for (int j = 0; j < C; j++)
                for (int part = 0; part < 4; part++) {
                    int gate = 2 * tile + (part >> 1);
                    int lane = G::FIRST_LANE + 8 * j + 2 * me.q + (part & 1);
                    Bits bits = memory.gates[t % STAGES][lane][gate * UNITS + me.unit];
                    sums[tile][j][part] = __uint_as_float((unsigned int)bits << 16);
                }
        if (t) {
            Arrivals* arrivals = &memory.arrivals[t & 1][G::NUMBER];
            wait_for(arrivals, (t - 1) >> 1);
            if (!me.index)
                expect(arrivals, RANKS * SENT * G::LANES);
        }
        multiply<W, UNITS>(sums, weights, &memory.hidden[t & 1][0][G::FIRST_LANE][0],
                           LANES * (UNITS + PAD), me);

        unsigned int rounded[2][C][2];  // input | forget, candidate | output
        for (int j = 0; j < C; j++)
            for (int e = 0; e < 2; e++) {
                rounded[0][j][e] = pack_bfloat16(sums[0][j][e], sums[0][j][2 + e]);
                rounded[1][j][e] = pack_bfloat16(sums[1][j][e], sums[1][j][2 + e]);
            }
        if (p.saved_gates) {
            long long first =
                COLUMNS * saved_block(t, cluster, p.n_clusters, RANKS, rank) + G::FIRST_COLUMN;
            for (int j = 0; j < C; j++) {
                long long at = (first + j) * THREADS + me.index;
                const float (&cell)[2] = cells[G::FIRST_COLUMN + j];
                __stcs((uint4*)p.saved_gates + at, uint4{rounded[0][j][0], rounded[1][j][0],
                                                         rounded[0][j][1], rounded[1][j][1]});
                __stcs((float2*)p.saved_cells + at, float2{cell[0], cell[1]});
            }
        }
        for (int j = 0; j < C; j++)
            for (int e = 0; e < 2; e++) {
                float& cell = cells[G::FIRST_COLUMN + j][e];
                float input = sigmoid(low_half(rounded[0][j][e]));
                float forget = sigmoid(high_half(rounded[0][j][e]));
                float candidate = tanh_of(low_half(rounded[1][j][e]));
                float output = sigmoid(high_half(rounded[1][j][e]));
                float after = forget * cell + input * candidate;
                Bits value = (Bits)pack_bfloat16(output * tanh_of(after), 0.f);
                bool is_reset = resets >> (G::FIRST_LANE + 8 * j + e) & 1;
                int lane = G::FIRST_LANE + 8 * j + 2 * me.q + e;
                memory.output[t & 1][lane][me.unit] = value;
                memory.next_hidden[t & 1][lane][me.unit] = is_reset ? (Bits)0 : value;
                cell = is_reset ? 0.f : after;
            }
        if (G::NUMBER)
            wait_for_copies<1>();
        publish();
        __syncthreads();
        if (me.index < RANKS && !is_last) {  // a thread per block that it sends to
            const Bits* target = memory.hidden[(t + 1) & 1][rank][G::FIRST_LANE];
            send(address_in(target, me.index), memory.next_hidden[t & 1][G::FIRST_LANE],
                 SENT * G::LANES, address_in(&memory.arrivals[(t + 1) & 1][G::NUMBER], me.index));
        }
        // the first threads write the next step's inputs, the others outputs
        constexpr int WORDS = G::LANES * UNITS / 8;
        for (int i = me.index; i < 2 * WORDS; i += THREADS) {
            bool is_input = i < WORDS;
            int word = is_input ? i : i - WORDS, lane = G::FIRST_LANE + (word >> 3);
            int part = 8 * (word & 7);
            bool exists = first_lane + lane < n_lanes;
            long long at = ((long long)t * n_lanes + first_lane + lane) * W + rank * UNITS + part;
            if (is_input && exists && !is_last)
                *(uint4*)(hiddens + at + (long long)n_lanes * W) =
                    *(const uint4*)&memory.next_hidden[t & 1][lane][part];
            else if (!is_input && exists) {
                uint4 value = *(const uint4*)&memory.output[t & 1][lane][part];
                if (is_last)
                    write_floats(
                        p.output + ((long long)first_lane + lane) * W + rank * UNITS + part, value);
                if (residual)
                    value = add(value,
                                *(const uint4*)&memory.residual[t % RESIDUAL_STAGES][lane][part]);
                *(uint4*)(outputs + at) = value;
            }
        }
    };
    for (int t = 0; t < n_steps; t++) {
        begin_gates(t + 2);
        run(t, Group<0>());
        run(t, Group<1>());
    }
    for (int j = 0; j < COLUMNS; j++)
        for (int e = 0; e < 2; e++) {
            int lane = first_lane + 8 * j + 2 * me.q + e;
            if (lane < n_lanes)
                p.cell[(long long)lane * W + unit] = cells[j][e];
        }
    cluster_barrier();  // no block ends while another sends to it
}

// ---- Backward ----

// Sums for units and a group's lanes, of even and odd steps: for each block and from each block.
// Rows are so far apart that the threads of half a warp write to different banks, mostly.
template <int RANKS, int N>
struct Exchange {
    static constexpr int BYTES = UNITS * N * (int)sizeof(float);  // for a block
    float sent[2][RANKS][UNITS][N], received[2][RANKS][UNITS][N];
};

template <int W>
struct BackwardMemory {
    static constexpr int RANKS = W / UNITS;
    Exchange<RANKS, 24> first;
    Exchange<RANKS, 20> second;
    Exchange<RANKS, 24>& of(Group<0>) { return first; }
    Exchange<RANKS, 20>& of(Group<1>) { return second; }
    Bits d_gates[LANES][GATES + PAD];
    Bits d_output[2][LANES][UNITS + PAD];
    Arrivals arrivals[2][2];
    Resets resets[MAX_STEPS];
};

template <int W>
DEVICE void lstm_backward(const LstmSequenceBackwardParams& p) {
    constexpr int RANKS = W / UNITS;
    constexpr int ROWS = W / (THREADS / 32), TILES = ROWS / 16;  // of a warp
    static_assert(ROWS % 16 == 0, "a warp multiplies whole tiles of 16 units");
    BackwardMemory<W>& memory = *(BackwardMemory<W>*)shared_memory;
    Thread me = this_thread();
    int rank = cluster_rank(), cluster = blockIdx.x / RANKS, first_lane = LANES * cluster;
    int n_steps = p.n_steps, n_lanes = p.n_lanes, last_lane = n_lanes - 1;
    int unit = rank * UNITS + me.unit;
    const unsigned char* reset = p.reset;
    const Bits* d_outputs = (const Bits*)p.d_outputs;
    Bits* d_gates = (Bits*)p.d_gates;

    auto begin_d_output = [&](int t) {
        if (t >= 0)
            for (int i = me.index; i < LANES * UNITS / 8; i += THREADS) {
                int lane = i >> 3, part = 8 * (i & 7);
                long long row = (long long)t * n_lanes + min(first_lane + lane, last_lane);
                begin_copy(&memory.d_output[t & 1][lane][part],
                           d_outputs + row * W + rank * UNITS + part);
            }
        end_group();
    };
    begin_d_output(n_steps - 1);

    // Rows: the units whose outputs fed the gates, ROWS per warp. Columns: this block's gates.
    unsigned int weights[TILES][GATES / 16][4];
    const Bits* weight = (const Bits*)p.weight;
#pragma unroll
    for (int tile = 0; tile < TILES; tile++)
        for (int k = 0; k < GATES / 16; k++)
            for (int part = 0; part < 4; part++) {
                int row = ROWS * me.warp + 16 * tile + me.g + 8 * (part & 1);
                int i = 16 * k + 2 * me.q + 8 * (part >> 1), gate = i / UNITS;
                weights[tile][k][part] = *(const unsigned int*)(weight + row * (4 * W) + gate * W +
                                                                rank * UNITS + i % UNITS);
            }

    float d_cells[COLUMNS][2], d_bias[4] = {0.f, 0.f, 0.f, 0.f};
    for (int j = 0; j < COLUMNS; j++)
        for (int e = 0; e < 2; e++) {
            int lane = first_lane + 8 * j + 2 * me.q + e;
            bool exists = p.d_cell && lane < n_lanes;
            d_cells[j][e] = exists ? p.d_cell[(long long)lane * W + unit] : 0.f;
        }
    // What was saved of the next step to go back through
    uint4 gates[COLUMNS];
    float2 cells[COLUMNS];
    auto load_saved = [&](int t, auto group) {
        typedef decltype(group) G;
        if (t < 0)
            return;
        long long first = COLUMNS * saved_block(t, cluster, p.n_clusters, RANKS, rank);
        for (int j = G::FIRST_COLUMN; j < G::FIRST_COLUMN + G::COLUMNS; j++) {
            long long at = (first + j) * THREADS + me.index;
            gates[j] = __ldcs((const uint4*)p.saved_gates + at);
            cells[j] = __ldcs((const float2*)p.saved_cells + at);
        }
    };
    load_saved(n_steps - 1, Group<0>());
    load_saved(n_steps - 1, Group<1>());
    read_resets(memory.resets, reset, n_steps, n_lanes, first_lane, me);
    if (!me.index)
        init_arrivals(memory.arrivals, RANKS * memory.first.BYTES, RANKS * memory.second.BYTES);
    wait_for_copies<0>();
    cluster_barrier();

    // The gradient of each lane's recurrent input of step t, added up in the order of the blocks
    auto receive = [&](float (&d_hiddens)[COLUMNS][2], int t, auto group) {
        typedef decltype(group) G;
        Arrivals* arrivals = &memory.arrivals[t & 1][G::NUMBER];
        auto& exchange = memory.of(G());
        wait_for(arrivals, (n_steps - 1 - t) >> 1);
        if (!me.index)
            expect(arrivals, RANKS * exchange.BYTES);
        for (int j = 0; j < G::COLUMNS; j++) {
            float2 sum = {0.f, 0.f};
            for (int other = 0; other < RANKS; other++) {
                float2 pair =
                    *(const float2*)&exchange.received[t & 1][other][me.unit][8 * j + 2 * me.q];
                sum.x += pair.x;
                sum.y += pair.y;
            }
            d_hiddens[j][0] = sum.x;
            d_hiddens[j][1] = sum.y;
        }
    };

    auto run = [&](int t, auto group) {
        typedef decltype(group) G;
        constexpr int C = G::COLUMNS;
        bool has_next = t + 1 < n_steps;
        Resets resets = has_next ? memory.resets[t + 1] >> (2 * me.q) : 0;
        float d_hiddens[COLUMNS][2];
        if (has_next)
            receive(d_hiddens, t + 1, group);
        for (int j = 0; j < C; j++)
            for (int e = 0; e < 2; e++) {
                constexpr int FIRST = G::FIRST_COLUMN;
                int lane = G::FIRST_LANE + 8 * j + 2 * me.q + e;
                unsigned int one = e ? gates[FIRST + j].z : gates[FIRST + j].x;
                unsigned int two = e ? gates[FIRST + j].w : gates[FIRST + j].y;
                float before = e ? cells[FIRST + j].y : cells[FIRST + j].x;
                float input = sigmoid(low_half(one)), forget = sigmoid(high_half(one));
                float candidate = tanh_of(low_half(two)), output = sigmoid(high_half(two));
                float after = tanh_of(forget * before + input * candidate);
                Bits bits = memory.d_output[t & 1][lane][me.unit];
                float d_output = __uint_as_float((unsigned int)bits << 16);
                float d_cell = d_cells[FIRST + j][e];
                if (has_next) {
                    bool cut = resets >> (G::FIRST_LANE + 8 * j + e) & 1;
                    d_output += cut ? 0.f : d_hiddens[j][e];
                    d_cell = cut ? 0.f : d_cell;
                }
                d_cell += d_output * output * (1.f - after * after);
                unsigned int d_one = pack_bfloat16(d_cell * candidate * input * (1.f - input),
                                                   d_cell * before * forget * (1.f - forget));
                unsigned int d_two = pack_bfloat16(d_cell * input * (1.f - candidate * candidate),
                                                   d_output * after * output * (1.f - output));
                d_cells[FIRST + j][e] = d_cell * forget;
                if (first_lane + lane >= n_lanes)
                    d_one = d_two = 0u;
                d_bias[0] += low_half(d_one);
                d_bias[1] += high_half(d_one);
                d_bias[2] += low_half(d_two);
                d_bias[3] += high_half(d_two);
                Bits* row = &memory.d_gates[lane][me.unit];
                row[0] = (Bits)d_one;
                row[UNITS] = (Bits)(d_one >> 16);
                row[2 * UNITS] = (Bits)d_two;
                row[3 * UNITS] = (Bits)(d_two >> 16);
            }
        load_saved(t - 1, group);
        if (G::NUMBER)
            wait_for_copies<0>();
        __syncthreads();
        float sums[TILES][C][4] = {};
        multiply<GATES, GATES>(sums, weights, &memory.d_gates[G::FIRST_LANE][0], 0, me);
        auto& exchange = memory.of(G());
        for (int tile = 0; tile < TILES; tile++)
            for (int upper = 0; upper < 2; upper++) {
                int row = ROWS * me.warp + 16 * tile + me.g + 8 * upper;
                float* to = &exchange.sent[t & 1][row / UNITS][row % UNITS][2 * me.q];
                for (int j = 0; j < C; j++)
                    *(float2*)(to + 8 * j) =
                        float2{sums[tile][j][2 * upper], sums[tile][j][2 * upper + 1]};
            }
        publish();
        __syncthreads();
        if (me.index < RANKS)  // a thread per block that it sends to
            send(address_in(exchange.received[t & 1][rank], me.index),
                 exchange.sent[t & 1][me.index], exchange.BYTES,
                 address_in(&memory.arrivals[t & 1][G::NUMBER], me.index));
        for (int n = 0; n < G::LANES * GATES / 8 / THREADS; n++) {
            int i = me.index + n * THREADS, lane = G::FIRST_LANE + (i >> 5), gate = i >> 3 & 3;
            int part = 8 * (i & 7);
            long long row = (long long)t * n_lanes + first_lane + lane;
            if (first_lane + lane < n_lanes)
                *(uint4*)(d_gates + row * (4 * W) + gate * W + rank * UNITS + part) =
                    *(const uint4*)&memory.d_gates[lane][gate * UNITS + part];
        }
    };
    for (int t = n_steps - 1; t >= 0; t--) {
        begin_d_output(t - 1);
        run(t, Group<0>());
        run(t, Group<1>());
    }
    auto end = [&](auto group) {
        typedef decltype(group) G;
        float d_hiddens[COLUMNS][2];
        receive(d_hiddens, 0, group);
        for (int j = 0; j < G::COLUMNS; j++)
            for (int e = 0; e < 2; e++) {
                int lane = G::FIRST_LANE + 8 * j + 2 * me.q + e;
                if (first_lane + lane < n_lanes) {
                    bool cut = memory.resets[0] >> lane & 1;
                    long long at = ((long long)first_lane + lane) * W + unit;
                    p.d_last_output[at] = cut ? 0.f : d_hiddens[j][e];
                    p.d_last_cell[at] = cut ? 0.f : d_cells[G::FIRST_COLUMN + j][e];
                }
            }
    };
    end(Group<0>());
    end(Group<1>());
    for (int gate = 0; gate < 4; gate++) {
        float sum = d_bias[gate];
        sum += __shfl_xor_sync(~0u, sum, 1);
        sum += __shfl_xor_sync(~0u, sum, 2);
        if (!me.q)
            p.d_bias[cluster * (4 * W) + gate * W + unit] = sum;
    }
    cluster_barrier();  // no block ends while another sends to it
}

static_assert(sizeof(ForwardMemory<128>) == FORWARD_MEMORY_128);
static_assert(sizeof(BackwardMemory<128>) == BACKWARD_MEMORY_128);
static_assert(sizeof(ForwardMemory<256>) == FORWARD_MEMORY_256);
static_assert(sizeof(BackwardMemory<256>) == BACKWARD_MEMORY_256);

INSTANCE(BOUNDS(2) lstm_sequence_forward_128, LstmSequenceForwardParams, lstm_forward<128>)
INSTANCE(BOUNDS(2) lstm_sequence_backward_128, LstmSequenceBackwardParams, lstm_backward<128>)
INSTANCE(BOUNDS(4) lstm_sequence_forward_256, LstmSequenceForwardParams, lstm_forward<256>)
INSTANCE(BOUNDS(4) lstm_sequence_backward_256, LstmSequenceBackwardParams, lstm_backward<256>)
