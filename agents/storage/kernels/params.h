// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

struct CopyParams {
    void* target;
    const void* source;
    unsigned int n_bytes;
    int is_aligned;  // both begin at a multiple of 16 bytes
};

struct CopyAllParams {
    CopyParams copies[24];
    const unsigned char* condition;  // (), false: nothing changes; null: true
    int n_copies;
};

struct SelectParams {
    void* target;        // (T, M, words)
    const void* source;  // (T, B, words)
    unsigned int n_steps;
    unsigned int n_words;  // per step and lane
    int word_size;         // 1, 4, 8 or 16 bytes
};

struct SelectLanesParams {
    SelectParams tensors[16];
    const long long* lanes;   // (M)
    unsigned int n_lanes;     // B
    unsigned int n_selected;  // M
};
