#pragma once

constexpr int ADAM_ROWS = 48;     // parameters of a launch
constexpr int ADAM_NUMBERS = 16;  // of a parameter, that a thread handles
