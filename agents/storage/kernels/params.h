// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

constexpr int MAX_SELECTED = 16;  // tensors that lanes are selected from, of a launch
constexpr int MAX_LEVELS = 8;     // of a sum tree
constexpr int SET_THREADS = 512;  // of the block that changes priorities
constexpr int MAX_SET = 8192;     // priorities that one block changes sooner than many kernels do
constexpr int READ_THREADS = 256;

struct SelectParams {
    void* target;        // (T, M, words)
    const void* source;  // (T, B, words)
    unsigned int n_steps;
    unsigned int n_words;      // per step and lane; less than 2^31 in all
    unsigned int first_block;  // of the launch that selects from it
    int word_size;             // 1, 4, 8 or 16 bytes
};

struct SelectLanesParams {
    SelectParams tensors[MAX_SELECTED];
    const long long* lanes;   // (M)
    unsigned int n_lanes;     // B
    unsigned int n_selected;  // M
    int n_tensors;
};

// ---- Replay buffer ----

// Sums of blocks of 32 children; level 0 holds the priorities.
struct TreeLevelParams {
    double* sums;
};

struct SumTreeParams {
    TreeLevelParams levels[MAX_LEVELS];
    int n_levels;
};

struct SampleTreeParams {
    SumTreeParams tree;
    const double* fractions;  // (M) from 0 to 1
    long long* index;         // (M), written
    double* probability;      // (M), written
    int n_samples;            // M
};

struct SetTreeParams {
    SumTreeParams tree;
    const long long* index;  // (n)
    const double* values;    // (n), finite and at least 0
    int n;
};

struct SetPrioritiesParams {
    SumTreeParams tree;
    const long long* index;        // (n)
    const float* errors;           // (n)
    double* values;                // (n), written: the new priorities
    const long long* n_added;      // ()
    const long long* n_available;  // ()
    double* new_priority;          // (), updated
    int n;
    int first_rollouts;  // without that many rollouts nothing changes
    float smallest;      // error
    float alpha;
};

struct ReadTensorParams {
    void* target;        // (rows, M, words)
    const void* source;  // (rows of the ring, B, words)
    unsigned int n_rows;
    unsigned int n_words;           // per entry
    unsigned int rows_per_rollout;  // T, or 1 for hidden states
    unsigned int first_block;       // of the launch that reads it
    int word_size;                  // 1, 2, 4, 8 or 16 bytes; 0: float16 becomes float32
};

struct ReadSequencesParams {
    ReadTensorParams tensors[MAX_SELECTED];
    const unsigned char* flags;    // (rows of the ring, B): starts, learns, terminal, truncated
    unsigned char* starts;         // (L + 1, M)
    unsigned char* learns;         // (L + 1, M)
    unsigned char* terminal;       // (L, M)
    unsigned char* truncated;      // (L, M)
    const long long* index;        // (M)
    const double* probability;     // (M)
    double* weights;               // (M), written: before their division by the largest
    float* weight;                 // (M)
    long long* age;                // (M)
    const long long* n_added;      // ()
    const long long* n_available;  // ()
    unsigned int n_tensors;
    unsigned int n_sequences;  // M
    unsigned int n_steps;      // L
    unsigned int n_lanes;      // B
    unsigned int n_rollouts;   // of the ring
    unsigned int rows_per_rollout;
    float beta;
};
