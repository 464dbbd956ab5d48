// How light falls: ambient light, and each light's where no wall of the layout occludes it.
#pragma once
#include "common.h"
#include "params.h"

constexpr float AMBIENT = 0.1f;

// Of a light of `intensity` at a distance of (dx, dy), never more than at 1 m.
HD float irradiance(float intensity, float dx, float dy) {
    return 2.f * intensity / maxf(dx * dx + dy * dy, 1.f);
}

// A wall as a light sees it: its direction v, and its start w from the light, both turned round if
// need be so that `area` = w x v is not negative. An area of 0 is a wall seen end on, which hides
// nothing.
struct Occluder {
    float vx, vy, wx, wy, area;
};

HD Occluder occluder_of(float light_x, float light_y, float ax, float ay, float bx, float by) {
    float vx = bx - ax, vy = by - ay;
    float wx = ax - light_x, wy = ay - light_y;
    float area = cross(wx, wy, vx, vy);
    float sign = area < 0.f ? -1.f : 1.f;
    return {sign * vx, sign * vy, sign * wx, sign * wy, sign * area};
}

// Does the segment from the light along d meet the wall, short of its last thousandth, where the
// lit texel's own wall lies? No division: both sides are multiplied by the determinant.
HD int occludes(const Occluder& wall, float dx, float dy) {
    float determinant = cross(dx, dy, wall.vx, wall.vy);
    float u = cross(wall.wx, wall.wy, dx, dy);
    return (wall.area > 0.f) & (wall.area < 0.999f * determinant) & (u >= 0.f) & (u <= determinant);
}

// The centre of a line's texel k of `width`.
HD void texel_centre(const float* line, int k, int width, float& x, float& y) {
    float u = ((float)k + 0.5f) / (float)width;
    x = mix(line[0], line[2], u);
    y = mix(line[1], line[3], u);
}
