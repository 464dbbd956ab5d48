// The images of seekers that wait are black.
#pragma once
#include "common/backend.h"

// B lanes, R pixels.
struct HideAndSeekImagesParams {
    const unsigned char* blind;  // (B)
    unsigned short* rgb;         // (B, 3, R) fp16: set to 0 where blind
    unsigned short* depth;       // (B, R) likewise
    int n_lanes;                 // B
    int n_pixels;                // R
};

HD void blacken(const HideAndSeekImagesParams& p, int lane) {
    int n = p.n_pixels;
    for (int i = 0; i < 3 * n && p.blind[lane]; i++)
        p.rgb[3ll * n * lane + i] = 0;
    for (int i = 0; i < n && p.blind[lane]; i++)
        p.depth[(long long)n * lane + i] = 0;
}

EACH(hideandseek_images, HideAndSeekImagesParams, p.n_lanes, 1, blacken(p, i))
