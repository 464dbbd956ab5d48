// One step of the minGRU: the product of its gates and the recurrence in one kernel. Gates never
// leave the registers of their thread.
//
// A block computes 64 units of 128 lanes, from the update gates and candidates of these units. The
// product's inner axis has parts of 64 units. All parts are copied to shared memory at once, each
// multiplied as soon as it is there; then come the states. The part with the block's own units is
// the last, as x is added to its outputs.
//
// A warp computes 32 units of 32 lanes. Of a 16 x 8 result, a thread holds lanes g and g + 8 and
// units 2 q and 2 q + 1, with g = thread / 4 and q = thread % 4 of the warp. It holds both gates of
// a unit.
//
// In shared memory, a row of a part, of a lane or of a weight, has eight words of 16 bytes. Word i
// of row r is at i ^ r % 8, so that words i of eight rows are in different banks. Rows of states
// are 32 bytes apart in the banks, for the same reason.
#include "common/dependent_launch.h"
#include "common/tensor_cores.h"
#include "constants.h"
#include "params.h"

// Blocks of a multiprocessor, as many as its shared memory holds: two leave a thread 128 registers.
#define BOUNDS(n_blocks) __launch_bounds__(STEP_THREADS, n_blocks)

constexpr int LANES = STEP_LANES, UNITS = STEP_UNITS, THREADS = STEP_THREADS;
constexpr int WARP_LANES = 32, WARP_UNITS = 32;
constexpr int LANE_TILES = WARP_LANES / 16;    // of a warp's results
constexpr int UNIT_TILES = WARP_UNITS / 8;     // of a gate's results
constexpr int WORD = 16;                       // bytes
constexpr int ROW_BYTES = 2 * UNITS;           // of a part
constexpr int ROW_WORDS = ROW_BYTES / WORD;    // of a part
constexpr int STATE_WORDS = 4 * UNITS / WORD;  // of a lane

typedef unsigned short Bits;  // of a bfloat16

static_assert(PART_BYTES == (LANES + 2 * UNITS) * ROW_BYTES, "a part has lanes and weights");
static_assert(BIAS_BYTES == 2 * ROW_BYTES, "both gates have biases");
static_assert(THREADS == 32 * (LANES / WARP_LANES) * (UNITS / WARP_UNITS), "warps fill a block");

extern __shared__ __align__(128) unsigned char shared_memory[];

// The update gate's activation, with the same bits as in the kernel that learns; see number.h.
DEVICE float activate(float x) { return __fdividef(1.f, 1.f + __expf(-x)); }

// Where a word of a part's row is, in bytes. Eight rows on, words have the same order. Word w ^ i
// is at the place of word w, ^ WORD * i.
DEVICE int word_at(int row, int word) { return row * ROW_BYTES + (word ^ (row & 7)) * WORD; }

// What a block of a minGRU of W units computes.
struct Block {
    int first_lane, first_unit;
};

template <int W>
DEVICE Block find_block() {
    int first_lane = LANES * (blockIdx.x / (W / UNITS));
    return {first_lane, UNITS * ((int)blockIdx.x % (W / UNITS))};
}

// Where a lane of a block is in arrays (B, W). A lane that does not exist is the last one.
template <int W>
DEVICE long long lane_at(const Block& block, int lane, const MingruStepParams& p) {
    return (long long)min(block.first_lane + lane, p.n_lanes - 1) * W;
}

// Begins to copy the biases.
template <int W>
DEVICE void begin_biases(unsigned char* biases, const Block& block, const MingruStepParams& p) {
    constexpr int WORDS = ROW_BYTES / WORD;  // of a gate
    int gate = threadIdx.x / WORDS, word = threadIdx.x % WORDS;
    const Bits* bias = (const Bits*)p.bias + gate * W + block.first_unit;
    if (gate < 2)
        begin_copy(biases + gate * ROW_BYTES + word * WORD, bias + word * (WORD / 2));
}

// Begins to copy the parts of the lanes and of the weights, the block's own units last.
template <int W>
DEVICE void begin_parts(unsigned char* parts, const Block& block, const MingruStepParams& p) {
    constexpr int STEP = THREADS / ROW_WORDS;  // rows that all threads copy at once
    static_assert(STEP % 8 == 0 && LANES % 8 == 0 && UNITS % STEP == 0, "see word_at");
    int row = threadIdx.x / ROW_WORDS, word = threadIdx.x % ROW_WORDS;
    unsigned char* target = parts + word_at(row, word);
    long long lanes[LANES / STEP];
#pragma unroll
    for (int i = 0; i < LANES / STEP; i++)
        lanes[i] = lane_at<W>(block, row + i * STEP, p);
    long long output = block.first_unit + row;
    const Bits* x = (const Bits*)p.x + word * (WORD / 2);
    const Bits* weight = (const Bits*)p.weight + output * W + word * (WORD / 2);
#pragma unroll 1  // the first copies begin before all addresses are known
    for (int i = 0, unit = block.first_unit; i < W / UNITS; i++, target += PART_BYTES) {
        unit = (unit + UNITS) % W;
#pragma unroll
        for (int n = 0; n < LANES / STEP; n++)
            begin_copy(target + n * STEP * ROW_BYTES, x + lanes[n] + unit);
#pragma unroll
        for (int gate = 0; gate < 2; gate++)
#pragma unroll
            for (int n = 0; n < UNITS; n += STEP)
                begin_copy(target + (LANES + gate * UNITS + n) * ROW_BYTES,
                           weight + (gate * W + n) * W + unit);
        end_group();
    }
}

// Begins to copy the states.
template <int W>
DEVICE void begin_states(unsigned char* states, const Block& block, const MingruStepParams& p) {
    constexpr int STEP = THREADS / STATE_WORDS;
    int row = threadIdx.x / STATE_WORDS, word = threadIdx.x % STATE_WORDS;
    const float* start = p.start + block.first_unit + word * (WORD / 4);
#pragma unroll
    for (int i = 0; i < LANES; i += STEP)
        begin_copy(states + (row + i) * STATE_BYTES + word * WORD,
                   start + lane_at<W>(block, row + i, p));
    end_group();
}

// Waits until this thread's groups of copies but the latest n, from 1 to STEP_PARTS, are done.
DEVICE void wait_for_all_but(int n) {
    static_assert(STEP_PARTS == 4, "a case for each");
    if (n == 1)
        wait_for_copies<1>();
    else if (n == 2)
        wait_for_copies<2>();
    else if (n == 3)
        wait_for_copies<3>();
    else
        wait_for_copies<4>();
}

// A thread's sums: by tile of lanes, gate and tile of units.
typedef float Sums[LANE_TILES][2][UNIT_TILES][4];

// Sets the sums to the biases. `units` is the warp's first.
DEVICE void begin_sums(Sums& sums, const unsigned char* biases, int units) {
    int q = threadIdx.x % 4;
#pragma unroll
    for (int gate = 0; gate < 2; gate++)
#pragma unroll
        for (int j = 0; j < UNIT_TILES; j++) {
            int unit = units + 8 * j + 2 * q;
            auto bias = *(const unsigned int*)(biases + gate * ROW_BYTES + 2 * unit);
#pragma unroll
            for (int m = 0; m < LANE_TILES; m++) {
                sums[m][gate][j][0] = sums[m][gate][j][2] = low_half(bias);
                sums[m][gate][j][1] = sums[m][gate][j][3] = high_half(bias);
            }
        }
}

// Adds a part's products. `lanes` and `units` are the warp's first.
DEVICE void multiply_part(Sums& sums, const unsigned char* part, int lanes, int units) {
    int thread = threadIdx.x % 32;
    // A thread gives the row of a matrix: of the lanes, matrices go down first, then right; of the
    // weights the other way round.
    int left_at = word_at(lanes + thread % 16, thread / 16);
    int right_at = word_at(LANES + units + thread / 16 * 8 + thread % 8, thread / 8 % 2);
#pragma unroll
    for (int k = 0; k < ROW_WORDS; k += 2) {
        unsigned int left[LANE_TILES][4], right[2][UNIT_TILES][2];
#pragma unroll
        for (int m = 0; m < LANE_TILES; m++) {
            unsigned int near[2], far[2];
            load_matrices(near, far, part + (left_at ^ k * WORD) + 16 * m * ROW_BYTES);
            left[m][0] = near[0];
            left[m][1] = near[1];
            left[m][2] = far[0];
            left[m][3] = far[1];
        }
#pragma unroll
        for (int gate = 0; gate < 2; gate++)
#pragma unroll
            for (int j = 0; j < UNIT_TILES; j += 2)
                load_matrices(right[gate][j], right[gate][j + 1],
                              part + (right_at ^ k * WORD) + (gate * UNITS + 8 * j) * ROW_BYTES);
#pragma unroll
        for (int m = 0; m < LANE_TILES; m++)
#pragma unroll
            for (int gate = 0; gate < 2; gate++)
#pragma unroll
                for (int j = 0; j < UNIT_TILES; j++)
                    multiply_add(sums[m][gate][j], left[m], right[gate][j][0], right[gate][j][1]);
    }
}

// Updates the thread's states in shared memory, and writes its outputs over the block's own part.
// `resets` has a bit for each lane of the warp, `residual_mask` those of x that are added.
DEVICE void update(const Sums& sums, unsigned char* part, unsigned char* states, int lanes,
                   int units, unsigned int resets, unsigned int residual_mask) {
    int g = threadIdx.x % 32 / 4, q = threadIdx.x % 4;
    states += (lanes + g) * STATE_BYTES + 4 * (units + 2 * q);
    int first_output = word_at(lanes + g, units / (WORD / 2)) + 4 * q;
    auto state_at = [&](int row, int j) {
        return (float2*)(states + row * STATE_BYTES + 4 * 8 * j);
    };
    auto output_at = [&](int row, int j) {
        return (unsigned int*)(part + (first_output ^ j * WORD) + row * ROW_BYTES);
    };
#pragma unroll
    for (int m = 0; m < LANE_TILES; m++)
#pragma unroll
        for (int half = 0; half < 2; half++) {
            int row = 16 * m + 8 * half;  // and g
            bool is_reset = resets >> (row + g) & 1;
            float2 before[UNIT_TILES];  // all are read before the first is written
            unsigned int residuals[UNIT_TILES];
#pragma unroll
            for (int j = 0; j < UNIT_TILES; j++) {
                before[j] = *state_at(row, j);
                residuals[j] = *output_at(row, j) & residual_mask;
            }
#pragma unroll
            for (int j = 0; j < UNIT_TILES; j++) {
                const float (&z)[4] = sums[m][0][j], (&c)[4] = sums[m][1][j];
                // rounded, as the gates are when learning
                unsigned int updates = pack_bfloat16(z[2 * half], z[2 * half + 1]);
                unsigned int candidates = pack_bfloat16(c[2 * half], c[2 * half + 1]);
                float2 state = before[j];
                if (is_reset)
                    state = {0.f, 0.f};
                state.x += activate(low_half(updates)) * (low_half(candidates) - state.x);
                state.y += activate(high_half(updates)) * (high_half(candidates) - state.y);
                *state_at(row, j) = state;
                *output_at(row, j) = pack_bfloat16(low_half(residuals[j]) + state.x,
                                                   high_half(residuals[j]) + state.y);
            }
        }
}

// Copies the warp's outputs and states to GPU memory.
template <int W>
DEVICE void write_results(const unsigned char* part, const unsigned char* states, int lanes,
                          int units, const Block& block, const MingruStepParams& p) {
    int thread = threadIdx.x % 32, n_lanes = p.n_lanes - block.first_lane;
    long long first = (long long)block.first_lane * W + block.first_unit + units;
    // Eight threads that read at once read from four words of rows r and r + 4, in other banks.
    int row = lanes + thread / 8 + thread / 4 % 2 * 4, word = thread % 4;
    Bits* outputs = (Bits*)p.outputs + first + row * W + word * (WORD / 2);
    part += word_at(row, units / (WORD / 2) + word);
#pragma unroll
    for (int i = 0; i < WARP_LANES; i += 8)
        if (row + i < n_lanes)
            *(uint4*)(outputs + i * W) = *(const uint4*)(part + i * ROW_BYTES);
    row = lanes + thread / 8;
    word = thread % 8;
    float* last = p.last + first + row * W + word * (WORD / 4);
    states += row * STATE_BYTES + 4 * units + word * WORD;
#pragma unroll
    for (int i = 0; i < WARP_LANES; i += 4)
        if (row + i < n_lanes)
            *(uint4*)(last + i * W) = *(const uint4*)(states + i * STATE_BYTES);
}

template <int W>
DEVICE void mingru_step(const MingruStepParams& p) {
    constexpr int PARTS = W / UNITS;
    static_assert(W % UNITS == 0 && PARTS <= STEP_PARTS, "parts are whole and fit");
    Block block = find_block<W>();
    int warp = threadIdx.x / 32;
    int lanes = warp / (UNITS / WARP_UNITS) * WARP_LANES;
    int units = warp % (UNITS / WARP_UNITS) * WARP_UNITS;
    unsigned char* states = shared_memory + PARTS * PART_BYTES;
    unsigned char* biases = states + LANES * STATE_BYTES;

    begin_biases<W>(biases, block, p);
    begin_parts<W>(shared_memory, block, p);
    begin_states<W>(states, block, p);
    // of a lane of the warp for each thread
    int lane = min(block.first_lane + lanes + (int)threadIdx.x % 32, p.n_lanes - 1);
    bool is_reset = p.reset[lane];

    Sums sums;
#pragma unroll 1  // keeps the code short
    for (int i = 0; i < PARTS; i++) {
        wait_for_all_but(PARTS - i);
        __syncthreads();
        if (i == 0)
            begin_sums(sums, biases, units);
        multiply_part(sums, shared_memory + i * PART_BYTES, lanes, units);
    }
    wait_for_copies<0>();
    __syncthreads();  // the states are here, and no warp reads the last part any more
    unsigned char* part = states - PART_BYTES;
    unsigned int resets = __ballot_sync(~0u, is_reset);
    update(sums, part, states, lanes, units, resets, 0u - p.is_residual);
    __syncwarp();
    write_results<W>(part, states, lanes, units, block, p);
}

INSTANCE(BOUNDS(2) mingru_step_64, MingruStepParams, mingru_step<64>)
INSTANCE(BOUNDS(2) mingru_step_128, MingruStepParams, mingru_step<128>)
INSTANCE(BOUNDS(1) mingru_step_192, MingruStepParams, mingru_step<192>)
INSTANCE(BOUNDS(1) mingru_step_256, MingruStepParams, mingru_step<256>)
