#pragma once

constexpr int MAX_COPIES = 24;    // of a launch
constexpr int MAX_SELECTED = 16;  // tensors that lanes are selected from, of a launch
constexpr int COPY_WORDS = 4;     // words of 16 bytes that a thread copies
constexpr int MAX_LEVELS = 8;     // of a sum tree
constexpr int SET_THREADS = 512;  // of the block that changes priorities
constexpr int MAX_SET = 8192;     // priorities that one block changes sooner than many kernels do
constexpr int READ_THREADS = 256;

// How a tensor of the replay buffer is read: as words of so many bytes, or converted. Integers from
// 0 to 255 become fractions from 0 to 1.
constexpr int COPY_16 = 0;
constexpr int COPY_8 = 1;
constexpr int COPY_4 = 2;
constexpr int COPY_2 = 3;
constexpr int COPY_1 = 4;
constexpr int BYTE_TO_LONG = 5;
constexpr int SHORT_TO_LONG = 6;
constexpr int INT_TO_LONG = 7;
constexpr int BYTE_TO_HALF = 8;
constexpr int BYTE_TO_FLOAT = 9;
constexpr int HALF_TO_FLOAT = 10;
