// Puts objects at random points of their environment's layout.
#pragma once
#include "common/philox.h"
#include "params.h"

// Returns 1 if object i of an environment can be put at (x, y): clear of agents, and of the objects
// that are there and are not to be placed after it.
HD int fits(const PlaceObjectsParams& p, int env, int i, float x, float y) {
    const ObjectsParams& o = p.objects;
    float size = radius_of(o, i % o.n_objects, objects_of(o)[i].size);
    float apart = p.scenery.radius + size + p.apart;
    for (int a = env * p.scenery.n_agents; a < (env + 1) * p.scenery.n_agents; a++) {
        float dx = x - p.positions[2 * a], dy = y - p.positions[2 * a + 1];
        if (dx * dx + dy * dy < apart * apart)
            return 0;
    }
    for (int k = env * o.n_objects; k < (env + 1) * o.n_objects; k++) {
        Object other = objects_of(o)[k];
        if ((p.mask[k] && k >= i) || !other.visible || (!p.mask[k] && other.carrier >= 0))
            continue;
        float dx = x - other.x, dy = y - other.y;
        apart = radius_of(o, k % o.n_objects, other.size) + size + p.apart;
        if (dx * dx + dy * dy < apart * apart)
            return 0;
    }
    return 1;
}

// Places the masked objects of an environment one after the other, each at the first point that
// fits, counted from a random one, with a random angle. One that fits nowhere is flagged, and put
// at the random point.
HD void place_objects_of(const PlaceObjectsParams& p, int env) {
    const ObjectsParams& o = p.objects;
    int any = 0;
    for (int i = env * o.n_objects; i < (env + 1) * o.n_objects; i++)
        any |= p.mask[i] != 0;
    if (!any)
        return;
    int layout = layout_of(p.scenery, env, p.error_flag);
    const float* points = p.points + 2 * (layout * (long long)p.n_points);
    for (int i = env * o.n_objects; i < (env + 1) * o.n_objects; i++) {
        if (!p.mask[i])
            continue;
        Philox bits = next_draw(p.counts, i, p.key0, p.key1);
        int first = below(bits.a, p.n_points), point = first, n_tried = 0;
        while (n_tried < p.n_points && !fits(p, env, i, points[2 * point], points[2 * point + 1])) {
            point = point + 1 == p.n_points ? 0 : point + 1;
            n_tried++;
        }
        if (n_tried == p.n_points)
            flag_error(p.error_flag, i, NO_ROOM);
        Object& object = objects_of(o)[i];
        object.x = points[2 * point];
        object.y = points[2 * point + 1];
        object.angle = 360.f * unit_float(bits.b) - 180.f;
        object.carrier = -1;
        object.visible = 1;
        int body = o.n_bodies ? mini(o.object_bodies[i % o.n_objects], o.n_bodies - 1) : -1;
        if (body >= 0)
            rest(bodies_of(o)[env * o.n_bodies + body]);
    }
}

EACH(place_objects, PlaceObjectsParams, p.scenery.n_envs, threads_for(p.scenery, n, 1024),
     place_objects_of(p, i))
