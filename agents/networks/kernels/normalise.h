// The parameters of the CPU's normalisation of a leaf of an observation.
#pragma once

struct NormaliseParams {
    const void* obs;     // (N, C, P) fp16 if is_half, else float32
    const float* mean;   // (C)
    const float* scale;  // (C)
    float* out;          // rows of C P numbers, row_stride apart
    int row_stride;
    int n_rows;      // N
    int n_channels;  // C
    int n_pixels;    // P: those of a channel share mean and scale
    int is_half;
    int n_threads;
};
