#pragma once

constexpr int MAX_COPIES = 24;    // of a launch
constexpr int MAX_SELECTED = 16;  // tensors that lanes are selected from, of a launch
constexpr int COPY_WORDS = 4;     // words of 16 bytes that a thread copies
