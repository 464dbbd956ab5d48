// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

struct PackRowParams {
    const float* source;  // (n); null: ones
    unsigned int first;   // its place in the bucket
    unsigned int n;
    unsigned int n_padded;     // zeros follow up to this many numbers
    unsigned int first_block;  // of the launch that packs it
};

struct PackParams {
    PackRowParams rows[96];
    const void* n_valid;  // (), the factor: int64, or float32 if is_float
    float* bucket;
    int n_rows;
    int is_float;
};

struct DivideParams {
    const float* bucket;  // (n), which begins at a multiple of 16 bytes, as the next
    float* average;       // (n), bucket / max(bucket[count], 1), and bucket[count] itself
    int n;                // a multiple of 4
    int count;
};
