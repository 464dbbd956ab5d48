// Rasterises objects by warps, only those in view.
#pragma once
#include "raster_cuda.h"
#include "render.h"

// Rasterises objects, and draws these into `drawn`. Called after the walls: objects that are
// off-screen or entirely behind them are skipped. Returns 1 if any was not.
template <int is_split>
DEVICE int raster_objects(View<is_split>& v, const RenderParams& p, const EnvScenery& scenery,
                          int env, int layout, int a, Float4* drawn) {
    const ObjectsParams& o = p.objects;
    float* tile_min = (float*)v.spans;
    int result = 0;
#pragma unroll 1
    for (int start = 0; start < o.n_objects; start += WARP) {
        int own = start + v.warp_lane;
        Object object = {};
        ScreenBounds bounds = {-1.f, 0.f, 0, 0};
        if (own < o.n_objects) {
            object = object_at(p, env, own);
            if (a == 0)
                settle(o, p.scenery, object, layout, env * o.n_objects + own);
            if (is_drawn(object) && object.carrier != a)
                bounds = bounds_of_disc(v.camera, v.screen, p.half_width, object.x, object.y,
                                        1.42f * object.size);  // with a crate's corners
        }
        __syncwarp();
        tile_min[v.warp_lane] = v.tile_min;
        __syncwarp();
        int is_seen = 0;
        if (bounds.distance2 >= 0.f)
#pragma unroll 1
            for (int tile = bounds.first / TILE; tile <= bounds.last / TILE; tile++)
                is_seen |= bounds.max_inverse >= tile_min[tile];
        unsigned int in_view = __ballot_sync(FULL_WARP, is_seen);  // a bit for each object
        if (!in_view)
            continue;
        result = 1;
        Pose pose = {object.x, object.y, 0.f, 0.f};
        if (in_view >> v.warp_lane & 1) {
            draw_texel(p, object, env, own, drawn);
            pose = pose_at(object.x, object.y, object.angle);
        }
        int end = o.line_starts[mini(start + WARP, o.n_objects)];
#pragma unroll 1
        for (int first = o.line_starts[start]; first < end; first += WARP) {
            int l = first + v.warp_lane;
            int k = l < end ? o.line_object[l] - start : 0;  // the warp lane that has its object
            int active = l < end && in_view >> k & 1;
            Pose its = {__shfl_sync(FULL_WARP, pose.x, k), __shfl_sync(FULL_WARP, pose.y, k),
                        __shfl_sync(FULL_WARP, pose.sine, k),
                        __shfl_sync(FULL_WARP, pose.cosine, k)};
            float size = __shfl_sync(FULL_WARP, object.size, k);
            if (active)
                drawn[l] = line_at(LOAD((const Float4*)o.ends + l), size, its);
            raster_group(v, drawn + l, scenery.n_agent_lines + first, active);
        }
    }
    return result;
}
