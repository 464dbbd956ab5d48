// Ranges of a lidar: the nearest wall along each ray, a thread per ray. Ray 0 looks ahead, the
// others follow counter-clockwise.
#pragma once
#include "params.h"

// A ray from (x, y) along the unit vector (dx, dy).
struct Ray {
    float x, y, dx, dy;
};

// Returns 0 only if a ray meets no wall of a box before `nearest` metres.
HD int may_meet(const Ray& ray, const float* box, float nearest) {
    float x = 0.5f * (box[0] + box[2]) - ray.x, y = 0.5f * (box[1] + box[3]) - ray.y;
    float half_x = 0.5f * (box[2] - box[0]) + 1e-3f, half_y = 0.5f * (box[3] - box[1]) + 1e-3f;
    float dx = ABS(ray.dx), dy = ABS(ray.dy);
    float aside = cross(ray.dx, ray.dy, x, y), ahead = ray.dx * x + ray.dy * y;
    float reach = half_x * dx + half_y * dy;
    return (ABS(aside) <= half_x * dy + half_y * dx) & (ahead + reach >= 0.f) &
           (ahead - reach <= nearest);
}

// The distance of a wall along a ray, infinite if they do not meet. Walls that share a corner
// compare it with the ray by the same bits, so no ray passes between them.
HD float meet(const Ray& ray, const float* wall) {
    float ax = wall[0] - ray.x, ay = wall[1] - ray.y, bx = wall[2] - ray.x, by = wall[3] - ray.y;
    float side_a = cross(ray.dx, ray.dy, ax, ay), side_b = cross(ray.dx, ray.dy, bx, by);
    if ((side_a < 0.f) == (side_b < 0.f))
        return INF_VALUE;
    float distance = cross(ax, ay, bx - ax, by - ay) / (side_b - side_a);
    return distance >= 0.f ? distance : INF_VALUE;
}

HD void scan_ray(const ScanParams& p, int i) {
    const SceneryParams& s = p.scenery;
    int agent = i / p.n_rays, r = i % p.n_rays, env = agent / s.n_agents;
    Ray ray = {p.positions[2 * agent], p.positions[2 * agent + 1], 0.f, 1.f};
    sincos_degrees(p.angles[agent] + p.pitch * (float)r, ray.dy, ray.dx);
    if (r == 0)
        flag_nonfinite(p.error_flag, env, ray.x, ray.y, p.angles[agent]);
    Walls walls = walls_of(s, layout_of(s, env, p.error_flag));
    float nearest = INF_VALUE;
    for (int b = walls.first_box; b < walls.end_box; b++) {
        if (!may_meet(ray, s.boxes + 4 * (long long)b, nearest))
            continue;
        int first = walls.first_wall + BOX_WALLS * (b - walls.first_box);
        int end = mini(first + BOX_WALLS, walls.end_wall);
        for (int w = first; w < end; w++)
            nearest = minf(nearest, meet(ray, s.walls + 4 * (long long)w));
    }
    nearest = nearest < p.range_min ? -INF_VALUE : nearest;
    p.ranges[i] = nearest > p.range_max ? INF_VALUE : nearest;
}

EACH(scan, ScanParams, (p.scenery.n_envs * p.scenery.n_agents * p.n_rays), p.scenery.n_threads,
     scan_ray(p, i))
