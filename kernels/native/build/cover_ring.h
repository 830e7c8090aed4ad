// Cover original triangles with the faces about a merge: what `cover_queued` does one face at a time, 8 at a time.
#pragma once
#include "builtin.h"
#include "build/fetch_merge.h"
#include "build/polygon_cuts.h"

// Bounds by the first face to try of each triangle, 8 triangles at a time.
template <class Covers>
void bound_firsts(const NearFaces& near, const Covers& covers, const double* corners, int begin, int end,
                  double* first_bound) {
    typedef FaceLanes::lanes lanes;
    for (int i = begin; i < end; i += 8) {
        alignas(64) double over[9][8] = {}, corner[9][8] = {};
        lanes found = {};
        FaceLanes::bits has_first = {};
        for (int k = 0; k < 8 && i + k < end; ++k) {
            const int first = near.find(covers.first.data[i + k]);
            const double* from = corners + 9 * (wp::int64)covers.triangle.data[i + k];
            has_first[k] = -(first >= 0);
            for (int x = 0; x < 9; ++x)
                corner[x][k] = from[x];
            for (int x = 0; x < 9 && first >= 0; ++x)
                over[x][k] = near.place[first >> 3][x][first & 7];
        }
        FaceLanes firsts;
        firsts.load(NearFaces::points(over, 0), NearFaces::points(over, 3), NearFaces::points(over, 6));
        for (int k = 0; k < 9; k += 3)
            found = FaceLanes::greater(found, firsts.distance_sq(NearFaces::points(corner, k)));
        *(lanes*)(first_bound + (i - begin)) = has_first ? found : lanes{} + __builtin_inf();
    }
}

template <class Replay, class Covers>
wp::int32 cover_ring(const Replay& replay, const Covers& covers, wp::vec3i merge, wp::int32 near_count, wp::int32 begin,
                     wp::int32 end, wp::float64 limit) {
    if (near_count > NEAR_ROOM)
        return begin;
    PolygonCuts cuts;
    NearFaces& near = cuts.near;
    near.node_of = replay.rings.corner_node.data;
    near.pos = (const double*)replay.pos.data;
    near.first_node = merge[0];
    near.second_node = merge[1];
    near.merged_node = merge[2];
    near.count = 0;
    for (double* x = &near.place[0][0][0]; x != &near.place[0][0][0] + NEAR_ROOM * 9; ++x)
        *x = 0.0;
    for (int i = 0; i < near_count; ++i)
        near.add(covers.near.data[i]);
    near.load_groups(0);
    auto slot_at = [&](int slot) { return replay.slot.data + SLOT_FIELDS * (wp::int64)slot; };
    auto corners_of = [&](int t) { return (const double*)replay.triangle_pos.data + 9 * (wp::int64)t; };
    const int columns = covers.face.shape[1];
    int used[COVER_SLOTS], count = 0;
    for (int i = begin; i < end; ++i) {
        const double* corner = corners_of(covers.triangle.data[i]);
        __builtin_prefetch(corner);
        __builtin_prefetch(corner + 8);
    }
    alignas(64) double first_bound[COVERS_AT_ONCE];
    bound_firsts(near, covers, (const double*)replay.triangle_pos.data, begin, end, first_bound);
    int list[COVERS_AT_ONCE], lists = 0;
    for (int i = begin; i < end; ++i)
        if (first_bound[i - begin] > limit)
            list[lists++] = covers.triangle.data[i];
    // What these are registered with.
    follow_lists(list, lists, [&](int slot) {
        __builtin_prefetch(near.node_of + 3 * slot_at(slot)[SLOT_FACE]);
        return slot_at(slot)[SLOT_SIBLING];
    });
    for (int i = begin, row = 0; i < end; ++i, ++row) {
        const int t = covers.triangle.data[i];
        int* found = covers.face.data + columns * (wp::int64)row;
        if (first_bound[i - begin] <= limit) {
            covers.count.data[row] = 1;
            covers.limit.data[row] = limit;
            found[0] = covers.first.data[i];
            continue;
        }
        near.count = near_count;
        near.groups = (near_count + 7) / 8;
        for (int slot = t; slot >= 0; slot = slot_at(slot)[SLOT_SIBLING]) {
            const int f = slot_at(slot)[SLOT_FACE];
            if (near.is_live(f) && near.find(f) < 0) {
                if (near.count == NEAR_ROOM)
                    return i;
                near.add(f);
            }
        }
        if (near.count == 0)
            return i;
        if (near.count > near_count)
            near.load_groups(near_count >> 3);
        cuts.start(corners_of(t));
        if (!cuts.cover(limit, used, count) || count > columns)
            return i;
        covers.count.data[row] = count;
        for (int k = 0; k < count; ++k)
            found[k] = near.face[used[k]];
        covers.limit.data[row] = limit;
    }
    return end;
}
