// Bins for points around an agent: 16 sectors of bearing relative to its heading and 3 bands of
// distance.
#pragma once
#include "common/math.h"
#include "constants.h"

constexpr int BINS = BANDS * SECTORS;
constexpr float BAND_ENDS[] = {1.5f, 4.f};  // metres

// Sector 0 is straight ahead, 4 to the left, 8 behind. Bearings are compared with the tangents of
// odd multiples of 11.25 degrees, which needs no arc tangent.
HD int sector_of(float ahead, float left) {
    float along = ahead < 0.f ? -ahead : ahead, across = left < 0.f ? -left : left;
    int sector = (across > 0.19891237f * along) + (across > 0.66817864f * along) +
                 (across > 1.49660576f * along) + (across > 5.02733949f * along);
    if (ahead < 0.f)
        sector = SECTORS / 2 - sector;
    return left < 0.f ? (SECTORS - sector) % SECTORS : sector;
}

HD int band_of(float ahead, float left) {
    float squared = ahead * ahead + left * left;
    return (squared > BAND_ENDS[0] * BAND_ENDS[0]) + (squared > BAND_ENDS[1] * BAND_ENDS[1]);
}

// The bin of the point (x, y) as seen from `pose`.
HD int bin_of(const Pose& pose, float x, float y) {
    float dx = x - pose.x, dy = y - pose.y;
    float ahead = pose.cosine * dx + pose.sine * dy, left = pose.cosine * dy - pose.sine * dx;
    return SECTORS * band_of(ahead, left) + sector_of(ahead, left);
}
