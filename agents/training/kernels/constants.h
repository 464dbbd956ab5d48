#pragma once

constexpr int EPISODE_METRICS = 8;    // of a world
constexpr int COLUMNS_THREADS = 256;  // of a block, for one sum over episodes
