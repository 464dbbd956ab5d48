// The parameters of each launch; see megastep/kernels/params.h.
//
// T steps, B lanes, W units. "compute" is the dtype of matrix products, float32 or bfloat16.
#pragma once

constexpr int MAX_LEAVES = 8;          // of an observation, that a launch handles
constexpr int NORMALISED_ROWS = 4;     // rows that a thread normalises at once
constexpr int NORMALISED_BLOCKS = 16;  // of a multiprocessor, that do so at once
constexpr int STRIP = 128;             // rows that a block adds up
constexpr int STRIP_THREADS = 256;     // of such a block
constexpr int HEADS_ROWS = 32;         // that a block of the heads' forward kernel handles
constexpr int ACT_THREADS = 8;         // that choose one lane's actions, one per choice
constexpr int MOMENTS_LANES = 256;     // of a block, for one statistic
constexpr int MOMENTS_THREADS = 1024;  // of a block that adds moments
constexpr int MASKED_ARRAYS = 4;       // whose moments a launch computes
constexpr int MASKED_THREADS = 256;    // of a block
constexpr int MASKED_NUMBERS = 8;      // of an array, that a thread reads
constexpr int CAST_ROWS = 48;          // weights of a launch
constexpr int CAST_THREADS = 256;      // of a block
constexpr int DUELLING_OUTPUTS = 8;    // action values of a lane, at most
constexpr int DUELLING_STRIP = 128;    // rows that a block of their gradients adds up
constexpr int DUELLING_THREADS = 256;  // of such a block, two columns each

constexpr float UNKNOWN_SCALE = 1e30f;  // divides a number that has not varied yet
constexpr float RESOLUTION = 1e-5f;     // of a mean, which rounding errors stay below

// The minGRU. Gates are the update gate before activation, and the candidate. `start` is the state
// before the first step, `last` the state after the last.

struct MingruParams {
    const void* gates;           // (T, B, 2 W) compute
    const unsigned char* reset;  // (T, B)
    const float* start;          // (B, W)
    void* states;                // (T, B, W) compute, the outputs without the residual; null when
                                 // forward: not wanted
    int n_steps;
    int n_lanes;
    int width;
    int n_units;  // units per thread
};

struct MingruForwardParams : MingruParams {
    const void* residual;  // (T, B, W) compute, added to `outputs`; null: nothing is
    void* outputs;         // (T, B, W) compute
    float* last;           // (B, W)
};

struct MingruBackwardParams : MingruParams {
    const void* d_outputs;  // (T, B, W) compute
    const float* d_last;    // (B, W); null: zeros
    void* d_gates;          // (T, B, 2 W) compute
    float* d_start;         // (B, W); null: not wanted
    void* d_residual;       // (T, B, W) compute, a copy of d_outputs; null: not wanted
    float* d_biases;        // (blocks, 2 W) d_gates summed over a block's lanes and all steps; or
                            // (B, 2 W), only over steps
    int adds_lanes;         // a block has whole lanes, and d_biases a row per block
};

// ---- Layers ----

// One leaf of an observation. Mean and scale belong to `group` neighbouring features.
struct IntakeLeafParams {
    const void* values;  // (T, B, n_features) float16 or float32
    const float* mean;   // (n_features / group)
    const float* scale;  // (n_features / group)
    int n_features;      // 0: there is no such leaf
    int group;
    int is_half;
};

struct NormaliseParams {
    IntakeLeafParams leaves[MAX_LEAVES];
    const long long* lanes;      // (M), the lanes to read; null: all, M = B
    void* features;              // (T, M, n_columns) bfloat16
    unsigned int n_rows;         // T M
    unsigned int n_lanes;        // B
    unsigned int n_selected;     // M
    unsigned int n_columns;      // a multiple of 4; those after the leaves' features are 0
    unsigned int n_plain_words;  // of four columns, before the first leaf without whole words
    unsigned int stride;         // between two rows of a thread
};

struct MomentsParams {
    IntakeLeafParams leaves[MAX_LEAVES];  // (B, n_features), without mean and scale
    const unsigned char* is_counted;      // (B)
    float* parts;                         // (n_statistics, n_parts, 3): lanes that count, mean, and
                                          // squares of what is beside it, per number of a lane
    int n_lanes;
};

struct RunningNormParams {
    float* mean;                 // (n)
    float* scale;                // (n)
    float* count;                // ()
    const float* new_mean;       // (n)
    const float* new_variance;   // (n)
    const long long* n_counted;  // ()
    int n;
};

struct AddMomentsParams {
    RunningNormParams norms[MAX_LEAVES];
    const unsigned char* is_counted;  // (), false: nothing changes; null: true
};

struct CastRowParams {
    const float* source;  // (n)
    void* target;         // (n_padded) bfloat16, at a multiple of 16 bytes
    unsigned int n;
    unsigned int n_padded;     // a multiple of 8
    unsigned int first_block;  // of the launch that handles it
};

struct CastParams {
    CastRowParams rows[CAST_ROWS];
    int n_rows;
};

// Numbers of which some are valid; the others may be anything.
struct MaskedArrayParams {
    const float* values;  // (n)
};

struct MaskedPartsParams {
    MaskedArrayParams arrays[MASKED_ARRAYS];
    const unsigned char* valid;  // (n), of all arrays
    float* parts;  // (n_arrays, n_blocks, 3): count, mean, sum of squared distances from it
    int n;
};

struct MaskedMomentsParams {
    const float* parts;  // (n_arrays, n_parts, 3)
    float* moments;      // (2, n_arrays), means and variances
    long long* n_valid;  // ()
    int n_parts;
};

// The critic's last layer, and the statistics of returns that it predicts in.
struct AddReturnsParams {
    float* weight;                    // (W)
    float* bias;                      // ()
    float* mean;                      // ()
    float* scale;                     // ()
    float* count;                     // ()
    const float* new_mean;            // ()
    const float* new_variance;        // ()
    const long long* n_valid;         // ()
    const unsigned char* is_counted;  // (), false: nothing changes; null: true
    int width;
    float min_rate;
    float min_scale;
};

struct BiasGradientParams {
    const void* d;          // (n_rows, n_columns) bfloat16, a row every d_stride numbers
    const void* activated;  // (n_rows, n_columns), as d_masked; null: no activation
    void* d_masked;  // d, 0 where `activated` is not above 0 (NaN counts as above); null without
    float* sums;     // (n_strips, n_columns), over STRIP rows each
    int n_rows;      // at most 2^31 - STRIP
    int n_columns;   // a multiple of 8
    int d_stride;    // a multiple of 8
};

struct SumRowsParams {
    const float* rows;  // (n_rows, n_columns)
    float* sums;        // (n_columns)
    int n_rows;
    int n_columns;
};

struct CategoricalActParams {
    const void* features;  // (B, W) compute
    const void* weight;    // (A n, W) compute
    const void* bias;      // (A n) compute
    const float* noise;    // (B, A, n), exponentially distributed; null: the most likely
    float* logits;         // (B, A, n), log-probabilities
    long long* actions;    // (B, A)
    float* logprobs;       // (B), of the joint actions
    int n_lanes;
    int width;  // a multiple of 8
    int n_agents;
    int n_choices;  // at most ACT_THREADS
};

// The heads of an update. A row of their product has the prediction and the actions' scores, and
// one of `hidden` the critic's hidden layer of W units before its ReLU, each padded to a multiple
// of 8. W = 8 without such a layer: then the value is the first of these columns.
struct HeadsParams {
    const void* product;        // (n_rows, first columns) bfloat16, a row every product_stride
    const void* hidden;         // (n_rows, W) bfloat16, a row every hidden_stride
    const void* target;         // (n_rows, n_predicted, padded) bfloat16, of the prediction
    const long long* actions;   // (n_rows, A)
    const float* value_weight;  // (W); null: there is no hidden layer
    const float* value_scale;   // ()
    int n_rows;                 // at most 2^31 - STRIP
    int n_predicted;
    int n_agents;
    int n_choices;
    int width;           // a multiple of 8, as strides are
    int product_stride;  // numbers
    int hidden_stride;
};

struct HeadsForwardParams : HeadsParams {
    const float* value_bias;  // (); null: 0
    const float* value_mean;  // ()
    float* logprobs;          // (n_rows), of the joint actions; null: not wanted
    float* entropies;         // (n_rows)
    float* errors;            // (n_rows), of the prediction; null: not wanted
    float* values;            // (n_rows)
};

struct HeadsBackwardParams : HeadsParams {
    const float* d_logprobs;   // (n_rows)
    const float* d_entropies;  // (n_rows)
    const float* d_errors;     // (n_rows)
    const float* d_values;     // (n_rows)
    void* d_product;           // (n_rows, n_columns) bfloat16, of both
    float* sums;               // (n_strips, n_columns + W + 8), of d_product, and the gradients
                               // of the value's weight and bias, over STRIP rows each
};

struct DuellingParams {
    const void* hidden;             // (n_rows, 2 W) bfloat16, after the ReLU
    const float* value_weight;      // (A, W)
    const float* advantage_weight;  // (A n, W)
    int n_rows;
    int width;      // a multiple of 8
    int n_agents;   // A
    int n_choices;  // A n is at most DUELLING_OUTPUTS
};

struct DuellingForwardParams : DuellingParams {
    const float* value_bias;      // (A)
    const float* advantage_bias;  // (A n)
    const float* noise;           // (2, n_rows, A) from 0 to 1; null: no random actions
    const float* epsilon;         // (n_rows); null: `usual_epsilon`
    float* values;                // (n_rows, A, n)
    long long* actions;           // (n_rows, A); null unless acting, like `logprobs`
    float* logprobs;              // (n_rows), of the joint actions with `usual_epsilon`
    float usual_epsilon;
};

struct DuellingBackwardParams : DuellingParams {
    const float* d_values;  // (n_rows, A, n)
    void* d_hidden;         // (n_rows, 2 W) bfloat16, before the ReLU
    float* sums;            // (n_strips, n_sums); see the kernel
    int n_sums;             // (2 + A + A n) W + A + A n
};

// The LSTM over a whole sequence, on the CPU. Everything is float32, W is a multiple of 16.

struct LstmSequenceParams {
    const float* input_weight;   // (4 W, W)
    const float* weight;         // (4 W, W) of the recurrent product
    const unsigned char* reset;  // (T, B) clears a lane's output and cell before the step
    float* gates;                // (T, B, 4 W) out when forward, as the next: after activation
    float* cells;                // (T, B, W) the last step's cell as a step sees it
    int n_steps;
    int n_lanes;
    int width;
    int n_threads;
};

struct LstmSequenceForwardParams : LstmSequenceParams {
    const float* x;             // (T, B, W)
    const float* bias;          // (4 W)
    const float* first_output;  // (B, W) before the sequence
    const float* first_cell;    // (B, W)
    float* hiddens;             // (T, B, W) out: the last step's output as a step sees it
    float* outputs;             // (T, B, W) out
    float* last_cell;           // (B, W) out
};

struct LstmSequenceBackwardParams : LstmSequenceParams {
    const float* d_outputs;    // (T, B, W)
    const float* d_last_cell;  // (B, W)
    float* d_gates;            // (T, B, 4 W) out: before activation
    float* d_x;                // (T, B, W) out
    float* d_output;           // (B, W) out: of the output before the sequence
    float* d_cell;             // (B, W) out
};

// A matrix product on the CPU: out = a b. Rows and columns of a and b are so many floats apart.

struct MatmulParams {
    const float* a;     // (rows, depth)
    const float* b;     // (depth, columns)
    const float* bias;  // (columns), or null
    float* out;         // (rows, columns), whose columns are 1 apart
    int a_row;
    int a_column;
    int b_row;
    int b_column;
    int out_row;
    int n_rows;
    int n_columns;
    int depth;
    int adds;      // to what `out` holds
    int has_relu;  // at the end
    int n_threads;
};
