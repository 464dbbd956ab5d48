// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// N rows of C channels and W columns, with F = 32 features in each of W' columns. Arrays are
// bfloat16 unless their type says otherwise. Sizes count numbers.
#pragma once

constexpr int CONV_CHANNELS = 32;  // of the hidden layer and of the features
constexpr int CONV_INPUTS = 8;     // channels of the images, at most
constexpr int CONV_ROWS = 16;      // of a tile, which a block convolves at once
constexpr int CONV_BLOCKS = 2;     // of a multiprocessor, at once
constexpr int CONV_THREADS = 128;  // of such a block

struct ConvParams {
    const void* rows;           // (N, C, W)
    const void* first_weight;   // (F, C, 8)
    const void* first_bias;     // (F)
    const void* second_weight;  // (F, F, 4)
    int n_rows;
    int n_channels;
    int n_columns;
    int row_stride;      // between two rows, at least C W
    int feature_stride;  // between two rows of features, at least F W'; backward a multiple of 8
};

struct ConvForwardParams : ConvParams {
    const void* second_bias;  // (F)
    void* features;           // (N, F, W')
    int channel_size;         // of a channel in shared memory
    int row_size;             // of a row in shared memory
    int feature_size;         // of a row's features in shared memory
};

struct ConvBackwardParams : ConvParams {
    const void* d_features;  // (N, F, W')
    const void* features;    // (N, F, W')
    float* sums;      // (n_blocks, 8 F C + F + 4 F F + F): each block's gradients of the first
                      // weight, the first bias, the second weight and the second bias
    int d_stride;     // between two rows of d_features, a multiple of 8
    int staged_size;  // of a row's features in shared memory
    int image_size;   // of a row in shared memory
};
