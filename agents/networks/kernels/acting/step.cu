// One step of a recurrent core: the product of its gates and the recurrence in one kernel. Gates
// never leave the registers of their thread.
//
// A block computes the gates of some units, of 128 rows of the weights, for its lanes. The inner
// axis has parts of 64 numbers, which are copied to shared memory while those before are
// multiplied. An LSTM's parts are first those of the last outputs, then those of x. The part with
// the block's own units of x is the last, as x is added to its outputs.
//
// A warp has the results of 16 lanes; four warps multiply together on a Hopper (wgmma). Of a 16 x 8
// result, a thread holds lanes g and g + 8 and units 2 q and 2 q + 1, with g = thread / 4 and
// q = thread % 4 of the warp. It holds all gates of a unit.
//
// In shared memory, a row of a part, of a lane or of a weight, has eight words of 16 bytes. Word i
// of row r is at i ^ r % 8, so that words i of eight rows are in different banks. A Hopper calls
// this a swizzle of 128 bytes, and wants parts at multiples of 1,024 bytes.
#include "common/tensor_cores.h"
#include "params.h"

constexpr int WARP_LANES = 16;
constexpr int WORD = 16;                     // bytes
constexpr int WORD_NUMBERS = 8;              // of a word
constexpr int ROW_BYTES = 2 * INNER;         // of a part
constexpr int ROW_WORDS = ROW_BYTES / WORD;  // of a part
constexpr int STAGE_BYTES = (LANES + ROWS) * ROW_BYTES;

static_assert(THREADS == 32 * LANES / WARP_LANES, "a warp for each 16 lanes");

extern __shared__ __align__(1024) unsigned char shared_memory[];

// The minGRU's update gate after activation, with the same bits as in the kernel that learns; see
// mingru.cu.
DEVICE float activate(float x) { return __fdividef(1.f, 1.f + __expf(-x)); }

// Where a word of a part's row is, in bytes. Eight rows on, words have the same order. Word w ^ i
// is at the place of word w, ^ WORD * i.
DEVICE int word_at(int row, int word) { return row * ROW_BYTES + (word ^ (row & 7)) * WORD; }

template <int N_GATES>
struct Block {
    static constexpr int GATES = N_GATES, UNITS = ROWS / GATES;
    static constexpr int UNIT_TILES = UNITS / 8;          // of a gate's results
    static constexpr int STATE_WORDS = 4 * UNITS / WORD;  // of a lane
    static constexpr bool HAS_OUTPUT = GATES == 4;        // which is multiplied, too

    int first_lane, first_unit;
    int lanes;  // the warp's first, in the block
};

template <class B>
DEVICE B find_block(const StepParams& p) {
    int per_row = p.width / B::UNITS, block = blockIdx.x;
    return {LANES * (block / per_row), B::UNITS * (block % per_row),
            (int)threadIdx.x / 32 * WARP_LANES};
}

// The word of the block's first unit in a row of the last part.
template <class B>
DEVICE int own_word(const B& block) {
    return block.first_unit % INNER / WORD_NUMBERS;
}

// A lane of the block. One that does not exist is the last one.
template <class B>
DEVICE int lane_of(const B& block, int lane, const StepParams& p) {
    return min(block.first_lane + lane, p.n_lanes - 1);
}

// A thread's sums: by gate and tile of units.
template <class B>
struct Sums {
    float of[B::GATES][B::UNIT_TILES][4];
};

// Begins to copy a part's rows of lanes and of weights. `resets` has a bit for each lane that this
// thread copies.
template <class B>
DEVICE void begin_part(int part, const B& block, unsigned int resets, const StepParams& p) {
    constexpr int STEP = THREADS / ROW_WORDS;  // rows that all threads copy at once
    static_assert(STEP % 8 == 0 && LANES % STEP == 0 && ROWS % STEP == 0, "see word_at");
    int row = threadIdx.x / ROW_WORDS, word = threadIdx.x % ROW_WORDS, of_x = p.width / INNER;
    bool is_output = B::HAS_OUTPUT && part < of_x;
    int first = INNER * (is_output ? part : (block.first_unit / INNER + 1 + part) % of_x);
    first += word * WORD_NUMBERS;
    const Bits* lanes = (const Bits*)(is_output ? p.last_output : p.x) + first;
    unsigned char* target = shared_memory + part % STAGES * STAGE_BYTES + word_at(row, word);
    for (int i = 0; i < LANES / STEP; i++) {
        const Bits* source = lanes + (long long)lane_of(block, row + i * STEP, p) * p.width;
        unsigned char* to = target + i * STEP * ROW_BYTES;
        if (B::HAS_OUTPUT)
            begin_copy_or_clear<WORD>(to, source, !(is_output && resets >> i & 1));
        else
            begin_copy(to, source);
    }
    int inner = (B::HAS_OUTPUT ? 2 : 1) * p.width;
    const Bits* weight = (const Bits*)p.weight + (is_output ? p.width : 0) + first;
    for (int i = 0; i < ROWS; i += STEP) {
        int gate = (row + i) / B::UNITS, unit = block.first_unit + (row + i) % B::UNITS;
        begin_copy(target + (LANES + i) * ROW_BYTES,
                   weight + (long long)(gate * p.width + unit) * inner);
    }
}

// Where a word of a lane's states is in their stage, in bytes.
template <class B>
DEVICE int state_at(int lane, int word) {
    return (lane * B::STATE_WORDS + (word ^ (lane & 7))) * WORD;
}

// Begins to copy the states into the stage of a part after the last.
template <class B>
DEVICE void begin_states(unsigned char* states, const B& block, const StepParams& p) {
    constexpr int STEP = THREADS / B::STATE_WORDS;  // lanes that all threads copy at once
    static_assert(LANES * B::STATE_WORDS * WORD <= STAGE_BYTES && STEP % 8 == 0, "they fit");
    int lane = threadIdx.x / B::STATE_WORDS, word = threadIdx.x % B::STATE_WORDS;
    const float* source = p.last_state + block.first_unit + word * (WORD / 4);
    for (int i = 0; i < LANES; i += STEP)
        begin_copy(states + state_at<B>(lane + i, word),
                   source + (long long)lane_of(block, lane + i, p) * p.width);
}

template <class B>
DEVICE void begin_sums(Sums<B>& sums, const B& block, const StepParams& p) {
    const Bits* bias = (const Bits*)p.bias + block.first_unit + threadIdx.x % 4 * 2;
    for (int gate = 0; gate < B::GATES; gate++)
        for (int j = 0; j < B::UNIT_TILES; j++) {
            unsigned int pair = *(const unsigned int*)(bias + gate * p.width + 8 * j);
            sums.of[gate][j][0] = sums.of[gate][j][2] = low_half(pair);
            sums.of[gate][j][1] = sums.of[gate][j][3] = high_half(pair);
        }
}

#ifdef __CUDA_ARCH_FEAT_SM90_ALL  // a Hopper

template <class B>
DEVICE void multiply_part(Sums<B>& sums, const unsigned char* part, const B& block) {
    const unsigned char* lanes = part + block.lanes / GROUP_ROWS * GROUP_ROWS * ROW_BYTES;
    unsigned long long left = swizzled_matrix(lanes);
    unsigned long long right = swizzled_matrix(part + LANES * ROW_BYTES);
    auto& of = (float (&)[ROWS / 8][4]) sums;
    begin_multiplying();
    for (int k = 0; k < ROW_WORDS; k += 2)
        multiply_add(of, left + k, right + k);
    end_multiplying(of);
}

#else

template <class B>
DEVICE void multiply_part(Sums<B>& sums, const unsigned char* part, const B& block) {
    int thread = threadIdx.x % 32;
    // A thread gives the row of a matrix: of the lanes, matrices go down first, then right; of the
    // weights the other way round.
    int left_at = word_at(block.lanes + thread % 16, thread / 16);
    int right_at = word_at(LANES + thread / 16 * 8 + thread % 8, thread / 8 % 2);
    for (int k = 0; k < ROW_WORDS; k += 2) {
        unsigned int left[4], right[2][2];
        load_matrices(left, part + (left_at ^ k * WORD));
        for (int gate = 0; gate < B::GATES; gate++)
            for (int j = 0; j < B::UNIT_TILES; j += 2) {
                const unsigned char* rows = part + (gate * B::UNITS + 8 * j) * ROW_BYTES;
                load_matrices(right[0], right[1], rows + (right_at ^ k * WORD));
                for (int i = 0; i < 2; i++)
                    multiply_add(sums.of[gate][j + i], left, right[i][0], right[i][1]);
            }
    }
}

#endif

// The next state and output, without the residual, of one unit, from number e of the thread's sums
// of a tile.
template <class B>
DEVICE float next(float& state, const float (&sums)[B::GATES][B::UNIT_TILES][4], int j, int e) {
    if constexpr (B::HAS_OUTPUT) {
        float input = sigmoid(sums[0][j][e]), forget = sigmoid(sums[1][j][e]);
        state = forget * state + input * tanh_of(sums[2][j][e]);
        // rounded, as when learning
        return low_half(pack_bfloat16(sigmoid(sums[3][j][e]) * tanh_of(state), 0.f));
    } else {
        // rounded, as the gates are when learning
        unsigned int gates = pack_bfloat16(sums[0][j][e], sums[1][j][e]);
        state += activate(low_half(gates)) * (high_half(gates) - state);
        return state;
    }
}

// Steps the thread's units. Writes states over those before, outputs over the block's own units of
// x in the last part, and those without a residual into `plain`.
template <class B>
DEVICE void update(const Sums<B>& sums, unsigned char* part, unsigned char* states,
                   unsigned char* plain, const B& block, const StepParams& p) {
    int thread = threadIdx.x % 32, g = thread / 4, q = thread % 4;
    // of a lane of the warp for each thread, twice
    int lane = lane_of(block, block.lanes + thread % WARP_LANES, p);
    unsigned int resets = __ballot_sync(~0u, p.reset[lane] != 0);
    unsigned int residual_mask = 0u - p.is_residual;
    int first_output = word_at(block.lanes + g, own_word(block)) + 4 * q;
    // words 2 j on are in the order of word 0, as with outputs
    int first_state = state_at<B>(block.lanes + g, q / 2) + q % 2 * 8;
#pragma unroll
    for (int half = 0; half < 2; half++) {
        int row = 8 * half;  // and g
        bool is_reset = resets >> (row + g) & 1;
        for (int j = 0; j < B::UNIT_TILES; j++) {
            auto& state =
                *(float2*)(states + (first_state ^ 2 * j * WORD) + row * B::STATE_WORDS * WORD);
            auto& output = *(unsigned int*)(part + (first_output ^ j * WORD) + row * ROW_BYTES);
            float2 now = is_reset ? float2{0.f, 0.f} : state;
            float x = next<B>(now.x, sums.of, j, 2 * half);
            float y = next<B>(now.y, sums.of, j, 2 * half + 1);
            state = now;
            if (B::HAS_OUTPUT)
                *(unsigned int*)(plain + (first_output ^ j * WORD) + row * ROW_BYTES) =
                    pack_bfloat16(x, y);
            unsigned int residual = output & residual_mask;
            output = pack_bfloat16(low_half(residual) + x, high_half(residual) + y);
        }
    }
}

// Copies words of the warp's lanes to GPU memory: WORDS of a lane, `stride` bytes from one to the
// next. `at` tells where a word is.
template <int WORDS, class At>
DEVICE void write_words(void* target, long long stride, const unsigned char* from, int n_lanes,
                        At at) {
    constexpr int STEP = 32 / WORDS;
    int lane = threadIdx.x % 32 / WORDS, word = threadIdx.x % WORDS;
    for (int i = lane; i < lane + WARP_LANES; i += STEP)
        if (i < n_lanes)
            *(uint4*)((char*)target + i * stride + word * WORD) =
                *(const uint4*)(from + at(i, word));
}

template <class B>
DEVICE void write_outputs(void* outputs, const unsigned char* part, const B& block, long long first,
                          const StepParams& p) {
    auto at = [&](int lane, int word) {
        return word_at(block.lanes + lane, own_word(block) + word);
    };
    int n_lanes = p.n_lanes - block.first_lane - block.lanes;
    write_words<B::UNITS / WORD_NUMBERS>((Bits*)outputs + first, 2ll * p.width, part, n_lanes, at);
}

template <class B>
DEVICE void write_states(const unsigned char* states, const B& block, long long first,
                         const StepParams& p) {
    auto at = [&](int lane, int word) { return state_at<B>(block.lanes + lane, word); };
    int n_lanes = p.n_lanes - block.first_lane - block.lanes;
    write_words<B::STATE_WORDS>(p.next_state + first, 4ll * p.width, states, n_lanes, at);
}

template <int GATES>
DEVICE void step(const StepParams& p) {
    typedef Block<GATES> B;
    B block = find_block<B>(p);
    int n_parts = (B::HAS_OUTPUT ? 2 : 1) * p.width / INNER;
    unsigned int resets = 0;
    if (B::HAS_OUTPUT)
        for (int i = 0; i < LANES * ROW_WORDS / THREADS; i++) {
            int lane = threadIdx.x / ROW_WORDS + i * (THREADS / ROW_WORDS);
            resets |= (p.reset[lane_of(block, lane, p)] ? 1u : 0u) << i;
        }
    auto stage = [](int i) { return shared_memory + i % STAGES * STAGE_BYTES; };
    auto begin = [&](int i) {
        if (i < n_parts)
            begin_part(i, block, resets, p);
        else if (i == n_parts)
            begin_states(stage(i), block, p);
        end_group();
    };
#pragma unroll 1
    for (int i = 0; i < STAGES - 1; i++)
        begin(i);
    Sums<B> sums;
    begin_sums(sums, block, p);
#pragma unroll 1  // keeps the code short
    for (int i = 0; i < n_parts; i++) {
        wait_for_copies<STAGES - 2>();
        publish();
        __syncthreads();  // the part is here, and no warp reads the one before any more
        begin(i + STAGES - 1);
        multiply_part(sums, stage(i), block);
    }
    wait_for_copies<0>();
    __syncthreads();
    unsigned char *part = stage(n_parts - 1), *states = stage(n_parts), *plain = stage(n_parts + 1);
    update(sums, part, states, plain, block, p);
    __syncwarp();
    long long first = (long long)(block.first_lane + block.lanes) * p.width;
    first += block.first_unit;
    write_states(states, block, first, p);
    write_outputs(p.outputs, part, block, first, p);
    if (B::HAS_OUTPUT)
        write_outputs(p.next_output, plain, block, first, p);
}

// Two blocks of a multiprocessor leave a thread 128 registers.
INSTANCE(__launch_bounds__(THREADS, 2) mingru_step, StepParams, step<2>)
INSTANCE(__launch_bounds__(THREADS, 2) lstm_step, StepParams, step<4>)
