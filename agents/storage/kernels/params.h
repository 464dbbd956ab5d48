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
    int n_copies;
};
