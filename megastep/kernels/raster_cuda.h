// A warp rasterises one camera's view, or a part of it, into shared memory, 32 lines at a time.
// Each warp lane projects one line of such a group. Then the warp visits each tile of 32 pixels
// that the group covers: each warp lane takes one pixel and keeps, of the lines that cover it, the
// one with the largest inverse depth, or the first of equals.
#pragma once
#include "render.h"

constexpr int TILE = WARP;  // pixels
static_assert(MAX_RES == TILE * WARP, "warp lane k holds tile_min of tile k");

// One camera's view while it is rasterised. Warp lane k holds tile_min of tile k: the smallest
// inverse depth among its pixels. `nearest` has whole tiles; pixels beyond the screen have infinite
// inverse depth, so they are never the smallest. If `is_split`, this warp has only `tiles` of the
// screen.
template <int is_split>
struct View {
    const Pose& camera;
    const Screen& screen;
    const float* ray_lengths;
    PixelSpan* spans;      // (32) in shared memory: the group's
    NearestLine* nearest;  // (whole tiles) in shared memory
    int warp_lane;
    Range tiles;
    float tile_min;
};

HD int whole_tiles(int res) { return (res + TILE - 1) & ~(TILE - 1); }

// Half of a screen's tiles for each of two warps.
HD Range half_of_screen(int res, int warp) {
    int n_tiles = whole_tiles(res) / TILE, middle = (n_tiles + 1) / 2;
    return {warp ? middle : 0, warp ? n_tiles : middle};
}

// Tiles of other warps look as if something at no distance hid all lines there.
template <int is_split>
DEVICE void clear(View<is_split>& v) {
    __syncwarp();
    int first = is_split ? TILE * v.tiles.first : 0;
    int end = is_split ? TILE * v.tiles.end : whole_tiles(v.screen.res);
    for (int r = first + v.warp_lane; r < end; r += WARP)
        v.nearest[r] = {r < v.screen.res ? 0.f : INF_VALUE, -1};
    int is_own = !is_split || (v.warp_lane >= v.tiles.first && v.warp_lane < v.tiles.end);
    v.tile_min = is_own ? 0.f : INF_VALUE;
}

// The nearest of a group's lines at pixel r: its inverse depth (0: none) and its slot in the group.
// `slots` has a bit for each line that covers the tile. Near-clipped lines are invisible where they
// are within the radius.
template <int is_split>
DEVICE NearestLine nearest_of_group(const View<is_split>& v, int r, unsigned int slots,
                                    unsigned int near_clipped) {
    float at = (float)r, max_inverse = 0.f;
    int slot = 0;
#pragma unroll 1
    for (unsigned int left = slots & ~near_clipped; left;) {
        int i = 31 - __clz(left);  // last line first, so that the first of equals wins
        PixelSpan span = v.spans[i];
        float inverse = span.base + span.gain * at;
        if (r >= span.first && r < span.end && inverse >= max_inverse) {
            max_inverse = inverse;
            slot = i;
        }
        left ^= 1u << i;
    }
#pragma unroll 1
    for (unsigned int left = slots & near_clipped; left; left &= left - 1) {
        int i = __ffs(left) - 1;
        PixelSpan span = v.spans[i];
        float inverse = span.base + span.gain * at;
        int is_first = inverse > max_inverse || (inverse == max_inverse && i < slot);
        if (r >= span.first && r < span.end && inverse * v.screen.radius < v.ray_lengths[r] &&
            is_first) {
            max_inverse = inverse;
            slot = i;
        }
    }
    return {max_inverse, slot};
}

// Rasterises 32 lines, one per warp lane, `ends` being this lane's. Lanes that are not `active`
// have none. `line` is the index, in its environment, of the first warp lane's line.
template <int is_split>
DEVICE void raster_group(View<is_split>& v, const Float4* ends, int line, int active) {
    Projection projection = {{0, 0, 0.f, 0.f}, 0};
    if (active) {
        Float4 e = LOAD(ends);
        projection = project(v.camera, v.screen, e.x, e.y, e.z, e.w);
    }
    PixelSpan span = projection.span;
    int visible = span.first < span.end;
    int first_tile = visible ? span.first >> 5 : 32;
    int last_tile = visible ? (span.end - 1) >> 5 : -1;
    if (is_split) {
        first_tile = maxi(first_tile, v.tiles.first);
        last_tile = mini(last_tile, v.tiles.end - 1);
    }
    float max_inverse = maxf(span.base + span.gain * (float)span.first,
                             span.base + span.gain * (float)(span.end - 1));
    unsigned int near_clipped = __ballot_sync(FULL_WARP, projection.near_clipped);
    __syncwarp();
    v.spans[v.warp_lane] = span;
    __syncwarp();
    int last = __reduce_max_sync(FULL_WARP, last_tile);
#pragma unroll 1
    for (int tile = __reduce_min_sync(FULL_WARP, first_tile); tile <= last; tile++) {
        float tile_min = __shfl_sync(FULL_WARP, v.tile_min, tile);
        int covers = first_tile <= tile && tile <= last_tile && max_inverse >= tile_min;
        unsigned int slots = __ballot_sync(FULL_WARP, covers);
        if (!slots)
            continue;
        int r = TILE * tile + v.warp_lane;
        NearestLine group = nearest_of_group(v, r, slots, near_clipped);
        NearestLine nearest = v.nearest[r];
        group.line += line;
        if (group.inverse > nearest.inverse ||
            (group.inverse == nearest.inverse && group.line < nearest.line)) {
            nearest = group;
            v.nearest[r] = nearest;
        }
        // Non-negative floats are ordered as their bits are.
        unsigned int min_bits = __reduce_min_sync(FULL_WARP, __float_as_uint(nearest.inverse));
        if (v.warp_lane == tile)
            v.tile_min = __uint_as_float(min_bits);
    }
}

// Rasterises walls, in groups of 32 with a bounding box around each. Groups that are off-screen are
// skipped. The others come nearest first, so that groups entirely behind earlier ones can be
// skipped too.
template <int drawn, int is_split>
DEVICE void raster_walls(View<is_split>& v, const RenderParams& p, const EnvScenery& scenery,
                         float half_width) {
    const SceneryParams& s = p.scenery;
    for (int start = 0; BOX_WALLS * start < scenery.n_walls; start += WARP) {
        unsigned int key = ~0u;
        ScreenBounds bounds = {-1.f, 0.f, 0, 0};
        if (BOX_WALLS * (start + v.warp_lane) < scenery.n_walls) {
            float4 box = ((const float4*)s.boxes)[scenery.first_box + start + v.warp_lane];
            bounds = bounds_of(v.camera, v.screen, half_width, box.x, box.y, box.z, box.w);
            int is_own = !is_split ||
                         (bounds.first < TILE * v.tiles.end && bounds.last >= TILE * v.tiles.first);
            if (bounds.distance2 >= 0.f && is_own)
                key = __float_as_uint(bounds.distance2);
        }
        int tiles = bounds.first / TILE | bounds.last / TILE << 16;
        for (unsigned int min_key = __reduce_min_sync(FULL_WARP, key); min_key != ~0u;
             min_key = __reduce_min_sync(FULL_WARP, key)) {
            int k = __ffs(__ballot_sync(FULL_WARP, key == min_key)) - 1;
            if (v.warp_lane == k)
                key = ~0u;
            int box_tiles = __shfl_sync(FULL_WARP, tiles, k);
            float max_inverse = __shfl_sync(FULL_WARP, bounds.max_inverse, k);
            int covers = v.warp_lane >= (box_tiles & 0xffff) && v.warp_lane <= box_tiles >> 16;
            float tile_min = covers ? v.tile_min : INF_VALUE;
            if (__all_sync(FULL_WARP, tile_min > max_inverse))
                continue;  // the box is entirely behind earlier ones
            int l = BOX_WALLS * (start + k);
            raster_group(v, (const Float4*)s.walls + (scenery.first_wall + l + v.warp_lane),
                         first_static_line<drawn>(p, scenery) + l,
                         l + v.warp_lane < scenery.n_walls);
        }
    }
}

// Rasterises the lines of all agents except agent a.
template <int is_split>
DEVICE void raster_agents(View<is_split>& v, const SceneryParams& s, const EnvScenery& scenery,
                          int a) {
    for (int first = 0; first < scenery.n_agent_lines; first += WARP) {
        int l = first + v.warp_lane;
        int active = l < scenery.n_agent_lines && l / s.n_model != a;
        raster_group(v, (const Float4*)scenery.agent_lines + l, first, active);
    }
}

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
                settle(o, p.scenery, object, layout, env * o.n_objects + own, p.error_flag);
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
        int end = lines_of(o, mini(start + WARP, o.n_objects) - 1).end;
#pragma unroll 1
        for (int first = lines_of(o, start).first; first < end; first += WARP) {
            int l = first + v.warp_lane;
            int k = l < end ? object_of(o, l) % WARP : 0;  // the warp lane that has its object
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
