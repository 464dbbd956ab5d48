// The parameters of a launch, passed by value; see megastep/kernels/params.h.
#pragma once

constexpr int MAX_COPIES = 24;  // of a launch

struct CopyParams {
    void* target;  // or an offset in the row
    const void* source;
    unsigned int n_bytes;      // less than 2^31
    unsigned int first_block;  // of the launch that copies it
    int is_aligned;            // both begin at a multiple of 16 bytes
};

struct CopyAllParams {
    CopyParams copies[MAX_COPIES];
    const unsigned char* condition;  // (), false: nothing changes; null: true
    long long* row;                  // (2) in and out: address of a row, 0; null: there are none
    unsigned int row_bytes;          // by which it moves on afterwards
    int n_copies;
};

struct EitherParams {
    const unsigned char* one;    // (n) bool
    const unsigned char* other;  // (n) bool
    unsigned char* out;          // (n) bool, out
    int n;
};
