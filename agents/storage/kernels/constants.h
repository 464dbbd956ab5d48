#pragma once

constexpr int MAX_COPIES = 24;    // of a launch
constexpr int MAX_SELECTED = 16;  // tensors that lanes are selected from, of a launch
constexpr int COPY_WORDS = 4;     // words of 16 bytes that a thread copies
constexpr int MAX_LEVELS = 8;     // of a sum tree
constexpr int SET_THREADS = 512;  // of the block that changes priorities
constexpr int MAX_SET = 8192;     // priorities that one block changes sooner than many kernels do
constexpr int READ_THREADS = 256;
