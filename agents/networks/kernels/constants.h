#pragma once

constexpr int MAX_LEAVES = 4;       // of an observation that is normalised at once
constexpr int NORMALISED_ROWS = 4;  // rows that a thread normalises
constexpr int MAX_CHOICES = 32;     // of a categorical action, one per lane of a warp
