// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes.
#pragma once

constexpr int ADAM_ROWS = 48;         // parameters of a launch
constexpr int ADAM_THREADS = 256;     // of a block, each for four numbers of a parameter
constexpr int JUDGED_METRICS = 32;    // of a gradient step
constexpr int CHECKED_TENSORS = 16;   // of a rollout
constexpr int CHECKED_THREADS = 256;  // of a block
constexpr int CHECKED_WORDS = 4;      // of 16 bytes, that a thread reads
constexpr int RECORD_THREADS = 1024;
constexpr int N_SUMS = 7;           // of PPO's loss: see PpoParams
constexpr int N_JOINT_SUMS = 16;    // with gradients of nine biases
constexpr int JOINT_ROWS = 128;     // of a block
constexpr int JOINT_THREADS = 256;  // of a block
constexpr int TD_THREADS = 256;     // of a block
constexpr int TD_SEQUENCES = 8;     // of a block, whose numbers fill a sector of 32 bytes
constexpr int N_TD_SUMS = 7;
constexpr int N_TD_METRICS = 7;

struct ReturnsParams {
    const float* reward;             // (T, B)
    const float* values;             // (T, B), of V-trace (T + 1, B)
    const unsigned char* reset;      // (T, B)
    const unsigned char* terminal;   // (T, B)
    const unsigned char* truncated;  // (T, B)
    float* advantages;               // (T, B)
    float* targets;                  // (T, B)
    const float* gamma;              // ()
    const float* lambda_;            // ()
    int n_steps;
    int n_lanes;
};

struct GaeParams : ReturnsParams {
    const float* last_value;      // (B)
    const unsigned char* learns;  // (T, B); null: all do
    unsigned char* valid;         // (T, B)
};

struct VtraceParams : ReturnsParams {
    const float* log_ratio;  // (T, B)
    const float* rho_clip;   // ()
    const float* c_clip;     // ()
};

struct PpoParams {
    const float* old_logprobs;    // (n_rows), when acting
    const float* old_values;      // (n_rows), when acting; null: values are not clipped
    const float* advantages;      // (n_rows)
    const float* targets;         // (n_rows)
    const unsigned char* valid;   // (n_rows)
    const long long* n_valid;     // ()
    const float* value_scale;     // ()
    const float* clip;            // ()
    const float* value_coef;      // ()
    const float* entropy_coef;    // ()
    const float* auxiliary_coef;  // ()
    // (n_blocks, N_SUMS), shares of means: policy, value, entropy, kl, clip_fraction, auxiliary,
    // loss; of joint_loss (n_blocks, N_JOINT_SUMS), then gradients of biases
    float* sums;
    int n_rows;
    float value_clip;
};

struct PpoLossParams : PpoParams {
    const float* logprobs;   // (n_rows), of the actions
    const float* entropies;  // (n_rows)
    const float* values;     // (n_rows)
    const float* errors;     // (n_rows), of the prediction; null: there is none
    float* d_logprobs;       // (n_rows), gradients of the loss
    float* d_entropies;      // (n_rows)
    float* d_values;         // (n_rows)
    float* d_errors;         // (n_rows)
};

// W features, n choices, at most eight. Weights and biases have rows of zeros up to eight.
struct JointLossParams : PpoParams {
    const void* features;      // (n_rows, W) bfloat16
    const void* weight;        // (8, W) bfloat16, of the scores
    const void* bias;          // (8) bfloat16
    const void* value_weight;  // (8, W) bfloat16
    const void* value_bias;    // (8) bfloat16
    const float* value_mean;   // ()
    const long long* actions;  // (n_rows)
    void* d_features;          // (n_rows, W) bfloat16
    void* d_columns;           // (n_rows, 16) bfloat16, of the scores and the value
    int width;                 // W, a multiple of 32
    int n_choices;             // n
};

// M sequences of T steps after the burn-in, A agents per lane, n choices.
struct TdLossParams {
    const float* q;                  // (T + 1, M, A, n), of the online network
    const float* target_q;           // (T + 1, M, A, n)
    const long long* actions;        // (T, M, A)
    const float* reward;             // (T, M)
    const unsigned char* terminal;   // (T, M)
    const unsigned char* truncated;  // (T, M)
    const unsigned char* starts;     // (T + 1, M)
    const unsigned char* learns;     // (T + 1, M)
    const float* weight;             // (M)
    const long long* age;            // (M)
    float* values;                   // (T + 1, M), written
    float* d_q;                      // (T + 1, M, A, n), of the sum over valid steps
    float* priorities;               // (M)
    float* sums;         // (n_blocks, 7): loss, |error|, q, valid steps; age, weight, weight^2
    const float* gamma;  // ()
    int n_steps;
    int n_sequences;
    int n_agents;
    int n_choices;
    int n_return_steps;
    float eta;
    float eps;  // of `returns.rescale`
};

struct TdMetricsParams {
    const float* sums;  // (n_blocks, 7)
    float* metrics;     // (7): those of `r2d2._METRICS`, valid steps, 1 / max(valid steps, 1)
    int n_blocks;
    int n_sequences;
};

// A parameter (n) with its gradient and Adam's running means.
struct AdamRowParams {
    float* parameter;
    const float* gradient;
    float* mean;
    float* square;
    unsigned int n;
    unsigned int first_block;  // of the launch that handles it
    int is_aligned;            // all begin at a multiple of 16 bytes
    float lr_factor;
    float weight_decay;
};

// A gradient or a metric (n), and where it goes.
struct BucketRowParams {
    const float* source;
    float* target;  // begins at a multiple of 16 bytes
    unsigned int n;
    unsigned int first_block;  // of the launch that handles it
    int is_aligned;            // as above
};

struct PackParams {
    BucketRowParams rows[ADAM_ROWS];
    const long long* n_valid;  // (), the factor
    float* total;              // (), n_valid
    int n_rows;
};

struct DivideParams {
    float* bucket;       // (n), divided by the total, if that is not 0
    const float* total;  // (), of all ranks
    long long* n_valid;  // (), written: the total
    int n;               // a multiple of 4
};

struct SquaredNormParams {
    AdamRowParams rows[ADAM_ROWS];
    float* sums;  // (n_sums), of this launch's blocks from first_sum on
    int n_rows;
    int first_sum;
};

struct MetricParams {
    const float* values;  // ()
};

struct JudgeParams {
    MetricParams metrics[JUDGED_METRICS];
    const float* sums;                // (n_sums), of squared gradients
    const unsigned char* is_finite;   // (), whether the transitions are
    const unsigned char* is_enabled;  // (); null: true
    const long long* n_valid;         // (), valid transitions
    float* n_steps;                   // (), updated
    float* grad_norm;                 // ()
    unsigned char* is_taken;          // ()
    float* totals;  // (n_metrics + 3), updated: metrics, the norm and 1 of steps taken; skipped
    int n_sums;
    int n_metrics;
    int is_first;  // `totals` begin here
};

struct AdamParams {
    AdamRowParams rows[ADAM_ROWS];
    const float* lr;                // ()
    const float* n_steps;           // (), this one included
    const float* grad_norm;         // ()
    const unsigned char* is_taken;  // (), false: nothing changes
    int n_rows;
    float max_norm;
    float beta1;
    float beta2;
    float eps;
};

// A tensor (n_steps, B, n_features) of a rollout, which begins at a multiple of 16 bytes.
struct CheckedTensorParams {
    const void* values;
    unsigned int first_block;  // of the launch that handles it
    int n_steps;               // T + 1, or T if it has no row of the first world
    int n_features;
    int is_half;  // float16, else float32
};

// A row is a step of a tensor, in the order (T + 1, n_tensors).
struct CheckedParams {
    CheckedTensorParams tensors[CHECKED_TENSORS];
    int* first_rows;  // (B), the first row with a number above the limit; larger if there is none
    int n_tensors;
    int n_steps;  // T + 1
    int n_lanes;
};

struct FindBadParams : CheckedParams {
    float limit;
};

struct RecordParams : CheckedParams {
    double* record;            // see NonFiniteCheck
    unsigned char* is_finite;  // ()
};
