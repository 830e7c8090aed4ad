// Cover original triangles with the faces about a merge: what `cover_queued` does one face at a time, 8 at a time.
#pragma once
#include "builtin.h"
#include "build/polygon_cuts.h"

template <class Replay, class Covers>
wp::int32 cover_ring(const Replay& replay, const Covers& covers, wp::vec_t<3, wp::int32> merge, wp::int32 near_count,
                     wp::int32 begin, wp::int32 end, wp::float64 limit) {
    typedef FaceLanes::lanes lanes;
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
    // As `cover_triangle`, of the one polygon on the stack; false where that has to do it.
    auto cover_triangle = [&]() {
        int top = 1, split = 0;
        count = 0;
        while (top > 0) {
            Polygon p = cuts.stack[--top];
            double bound;
            const int best = near.cover(p, limit, bound);
            bool final = bound <= limit;
            if (!final) {
                const double least = near.reach(p);
                if (least > limit)
                    return false;  // another face may be nearer
                const double enough = 1.1 * least > limit ? 1.1 * least : limit;
                final =
                    bound <= enough || split >= COVER_CUTS || top + 4 >= POLYGON_STACK || p.count + 4 > POLYGON_CORNERS;
            }
            if (final) {
                int at = 0;
                while (at < count && used[at] != best)
                    ++at;
                if (at == COVER_SLOTS)
                    return false;
                count += at == count;
                used[at] = used[count - 1];
                used[count - 1] = best;
                limit = bound > limit ? bound : limit;
            } else {
                ++split;
                top = cuts.split_at_middle(p, top, limit);
                if (top < 0)
                    return false;
            }
        }
        return true;
    };
    for (int i = begin; i < end; ++i) {
        const double* corner = corners_of(covers.triangle.data[i]);
        __builtin_prefetch(corner);
        __builtin_prefetch(corner + 8);
    }
    // Bounds by the first face to try of each triangle, 8 triangles at a time.
    alignas(64) double first_bound[COVERS_AT_ONCE];
    for (int i = begin; i < end; i += 8) {
        alignas(64) double over[9][8] = {}, corner[9][8] = {};
        lanes found = {};
        FaceLanes::bits has_first = {};
        for (int k = 0; k < 8 && i + k < end; ++k) {
            const int first = near.find(covers.first.data[i + k]);
            const double* from = corners_of(covers.triangle.data[i + k]);
            has_first[k] = -(first >= 0);
            for (int x = 0; x < 9; ++x)
                corner[x][k] = from[x];
            for (int x = 0; x < 9 && first >= 0; ++x)
                over[x][k] = near.place[first >> 3][x][first & 7];
        }
        FaceLanes firsts;
        firsts.load(over);
        for (int k = 0; k < 9; k += 3) {
            const FaceLanes::Point p = {*(const lanes*)corner[k], *(const lanes*)corner[k + 1],
                                        *(const lanes*)corner[k + 2]};
            found = FaceLanes::higher(found, firsts.distance_sq(p));
        }
        *(lanes*)(first_bound + (i - begin)) = has_first ? found : lanes{} + __builtin_inf();
    }
    // Bring what the rest of these triangles are registered with into the cache, one step of all lists at a time.
    int list[COVERS_AT_ONCE], lists = 0;
    for (int i = begin; i < end; ++i)
        if (first_bound[i - begin] > limit)
            list[lists++] = covers.triangle.data[i];
    while (lists > 0) {
        int kept = 0;
        for (int k = 0; k < lists; ++k) {
            __builtin_prefetch(near.node_of + 3 * slot_at(list[k])[SLOT_FACE]);
            const int sibling = slot_at(list[k])[SLOT_SIBLING];
            if (sibling >= 0)
                list[kept++] = sibling;
        }
        lists = kept;
    }
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
        if (!cover_triangle() || count > columns)
            return i;
        covers.count.data[row] = count;
        for (int k = 0; k < count; ++k)
            found[k] = near.face[used[k]];
        covers.limit.data[row] = limit;
    }
    return end;
}
