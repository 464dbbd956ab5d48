// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes, P policies. Arrays that belong to weights or to a policy's statistics start
// with the axis P; whatever is per lane has those of all policies.
#pragma once

struct GaeParams {
    const float* reward;             // (T, B)
    const float* values;             // (T, B)
    const float* last_value;         // (B)
    const unsigned char* reset;      // (T, B)
    const unsigned char* terminal;   // (T, B)
    const unsigned char* truncated;  // (T, B)
    const unsigned char* learns;     // (T, B); null: all do
    float* advantages;               // (T, B)
    float* targets;                  // (T, B)
    unsigned char* valid;            // (T, B)
    const float* gamma;              // ()
    const float* lambda_;            // ()
    int n_steps;
    int n_lanes;
};

struct OrderParams {
    const float* keys;  // (n), no NaN
    long long* order;   // (n), indices of the keys from the smallest on
    int n;
};

struct VtraceParams {
    const float* log_ratio;          // (T, B)
    const float* reward;             // (T, B)
    const float* values;             // (T + 1, B)
    const unsigned char* reset;      // (T, B)
    const unsigned char* terminal;   // (T, B)
    const unsigned char* truncated;  // (T, B)
    float* advantages;               // (T, B)
    float* targets;                  // (T, B)
    const float* gamma;              // ()
    const float* lambda_;            // ()
    const float* rho_clip;           // ()
    const float* c_clip;             // ()
    int n_steps;
    int n_lanes;
};

struct PpoLossParams {
    const float* logprobs;       // (P, n_rows), of the actions
    const float* entropies;      // (P, n_rows)
    const float* values;         // (P, n_rows)
    const float* errors;         // (P, n_rows), of the prediction; null: there is none
    const float* old_logprobs;   // (P, n_rows), when acting
    const float* old_values;     // (P, n_rows), when acting; null: values are not clipped
    const float* advantages;     // (P, n_rows)
    const float* targets;        // (P, n_rows)
    const unsigned char* valid;  // (P, n_rows)
    const long long* n_valid;    // (P)
    const float* value_scale;    // (P)
    float* d_logprobs;           // (P, n_rows), gradients of the loss
    float* d_entropies;          // (P, n_rows)
    float* d_values;             // (P, n_rows)
    float* d_errors;             // (P, n_rows)
    // (P, n_blocks, N_SUMS), shares of means: policy, value, entropy, kl, clip_fraction, auxiliary,
    // loss
    float* sums;
    const float* clip;            // (P)
    const float* value_coef;      // (P)
    const float* entropy_coef;    // (P)
    const float* auxiliary_coef;  // (P)
    int n_rows;
    float value_clip;
};

// M sequences of T steps after the burn-in, A agents per lane, n choices.
struct TdLossParams {
    const float* q;                  // (P, T + 1, M, A, n), of the online network
    const float* target_q;           // (P, T + 1, M, A, n)
    const long long* actions;        // (P, T, M, A)
    const float* reward;             // (P, T, M)
    const unsigned char* terminal;   // (P, T, M)
    const unsigned char* truncated;  // (P, T, M)
    const unsigned char* starts;     // (P, T + 1, M)
    const unsigned char* learns;     // (P, T + 1, M)
    const float* weight;             // (P, M)
    const long long* age;            // (P, M)
    float* values;                   // (P, T + 1, M), written
    float* d_q;                      // (P, T + 1, M, A, n), of the sum over valid steps
    float* priorities;               // (P, M)
    float* sums;         // (P, n_blocks, 7): loss, |error|, q, valid steps; age, weight, weight^2
    const float* gamma;  // (P)
    int n_steps;
    int n_sequences;
    int n_agents;
    int n_choices;
    int n_return_steps;
    float eta;
    float eps;  // of `returns.rescale`
};

struct TdMetricsParams {
    const float* sums;  // (P, n_blocks, 7)
    float* metrics;     // (P, 7): those of `td_loss.METRICS`, valid steps, 1 / max(valid steps, 1)
    int n_blocks;
    int n_sequences;
};

// A parameter (P, n) with its gradient and Adam's running means.
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

struct SquaredNormParams {
    AdamRowParams rows[48];
    float* sums;  // (P, n_sums), of this launch's blocks from first_sum on
    int n_rows;
    int n_sums;
    int first_sum;
};

struct MetricParams {
    const float* values;  // (P)
};

struct JudgeParams {
    MetricParams metrics[32];
    const float* sums;                // (P, n_sums), of squared gradients
    const unsigned char* is_finite;   // (P), whether the transitions are
    const unsigned char* is_enabled;  // (P); null: true
    const long long* n_valid;         // (P), valid transitions
    float* n_steps;                   // (P), updated
    float* grad_norm;                 // (P)
    unsigned char* is_taken;          // (P)
    float* totals;  // (P, n_metrics + 3), updated: metrics, the norm and 1 of steps taken; skipped
    int n_sums;
    int n_metrics;
    int is_first;  // `totals` begin here
};

struct AdamParams {
    AdamRowParams rows[48];
    const float* lr;                // (P)
    const float* n_steps;           // (P), this one included
    const float* grad_norm;         // (P); null: gradients are not clipped
    const unsigned char* is_taken;  // (P), false: nothing changes
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

struct FindBadParams {
    CheckedTensorParams tensors[16];
    int* first_rows;  // (B), the first row with a number above the limit; larger if there is none
    int n_tensors;
    int n_steps;  // T + 1
    int n_lanes;
    float limit;
};

struct RecordParams {
    CheckedTensorParams tensors[16];
    const int* first_rows;     // (B)
    double* record;            // see NonFiniteCheck
    unsigned char* is_finite;  // ()
    int n_tensors;
    int n_steps;  // T + 1
    int n_lanes;
    int n_named;
};
