#pragma once

constexpr int CONV_CHANNELS = 32;  // of the hidden layer and of the features
constexpr int CONV_INPUTS = 8;     // channels of the images, at most
constexpr int CONV_ROWS = 16;      // of a tile, which a block convolves at once
constexpr int CONV_THREADS = 128;  // of such a block
constexpr int CONV_BLOCKS = 2;     // of a multiprocessor, at once
