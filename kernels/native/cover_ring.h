// Cover original triangles with the faces about a merge: what `cover_queued` does one face at a time, 8 at a time.
#pragma once
#include "builtin.h"
#include "face_lanes.h"
#include "simd_float64.h"
#include "sizes.h"

template <class Replay, class Covers>
wp::int32 cover_ring(Replay replay, Covers covers, wp::vec_t<3, wp::int32> merge, wp::int32 near_count,
                     wp::int32 begin, wp::int32 end) {
#if defined(__CUDA_ARCH__)
    __trap();  // models are built on the host
#else
#include "face_lanes.h"
#include "sizes.h"
    typedef FaceLanes::lanes lanes;
    typedef FaceLanes::bits bits;
    // A corner of a polygon, and where its distances to the faces stand.
    struct Corner {
        double x, y, z;
        const double* distance;
    };
    struct Polygon {
        int count;
        Corner corner[POLYGON_CORNERS];
    };
    if (near_count > NEAR_ROOM)
        return begin;
    constexpr int GROUPS = NEAR_ROOM / 8;
    alignas(64) double place[GROUPS][9][8];
    FaceLanes group[GROUPS];
    alignas(64) double distance[DISTANCE_ROOM];
    int face[NEAR_ROOM];
    const int* node_of = replay.rings.corner_node.data;
    const double* pos = (const double*)replay.pos.data;
    int faces = 0, groups = 0, rows = 0;

    auto is_merged = [&](int node) { return node == merge[0] || node == merge[1]; };
    // Whether a face has three corners after the merge.
    auto is_live = [&](int f) {
        const int* node = node_of + 3 * f;
        return node[0] >= 0 && is_merged(node[0]) + is_merged(node[1]) + is_merged(node[2]) < 2;
    };
    auto find = [&](int f) {
        int i = 0;
        while (i < faces && face[i] != f)
            ++i;
        return i < faces ? i : -1;
    };
    auto add = [&](int f) {
        for (int k = 0; k < 3; ++k) {
            const int node = node_of[3 * f + k];
            const double* from = pos + 3 * (wp::int64)(is_merged(node) ? merge[2] : node);
            for (int x = 0; x < 3; ++x)
                place[faces >> 3][3 * k + x][faces & 7] = from[x];
        }
        face[faces++] = f;
    };
    auto load_groups = [&](int from) {
        groups = (faces + 7) / 8;
        for (int g = from; g < groups; ++g)
            group[g].load(place[g]);
    };
    auto measure = [&](const Corner& p, double* row) {
        const FaceLanes::Point q = FaceLanes::spread(p.x, p.y, p.z);
        for (int g = 0; g < groups; ++g)
            *(lanes*)(row + 8 * g) = group[g].distance_sq(q);
    };
    // Distances of 8 faces; infinite where there is no face.
    auto those_of = [&](const lanes& found, int g) {
        const lanes place_in = {0, 1, 2, 3, 4, 5, 6, 7};
        return place_in < double(faces - 8 * g) ? found : lanes{} + __builtin_inf();
    };
    auto lane_of = [&](const lanes& found, double value) { return __builtin_ctz(Float64::to_mask(found == value)); };
    auto nearest = [&](const double* row, double& least) {
        int best = -1;
        least = __builtin_inf();
        for (int g = 0; g < groups; ++g) {
            const lanes found = those_of(*(const lanes*)(row + 8 * g), g);
            const double here = FaceLanes::least(found);
            if (here < least) {
                least = here;
                best = 8 * g + lane_of(found, here);
            }
        }
        return best;
    };
    // As `nearest_face`: the first face within the limit, else the one with the least bound.
    auto cover = [&](const Polygon& p, double limit, double& bound) {
        int best = -1;
        bound = __builtin_inf();
        for (int g = 0; g < groups && bound > limit; ++g) {
            lanes worst = {};
            for (int k = 0; k < p.count; ++k)
                worst = FaceLanes::higher(worst, *(const lanes*)(p.corner[k].distance + 8 * g));
            worst = those_of(worst, g);
            const unsigned int within = Float64::to_mask(worst <= limit);
            const double here = within ? worst[__builtin_ctz(within)] : FaceLanes::least(worst);
            if (here < bound) {
                bound = here;
                best = 8 * g + (within ? __builtin_ctz(within) : lane_of(worst, here));
            }
        }
        return best;
    };
    // As `cut_polygon`; false where there is no room for distances.
    auto cut = [&](Polygon& p, Polygon& rest, const double (&normal)[3], const double* origin, double margin) {
        double height[POLYGON_CORNERS];
        int above = 0, below = 0;
        for (int i = 0; i < p.count; ++i) {
            const Corner& q = p.corner[i];
            height[i] = normal[0] * (q.x - origin[0]) + normal[1] * (q.y - origin[1]) + normal[2] * (q.z - origin[2]);
            above += height[i] > margin;
            below += height[i] < -margin;
        }
        rest.count = 0;
        if (below == 0)
            return true;
        if (above == 0) {
            rest = p;
            p.count = 0;
            return true;
        }
        Polygon kept;
        kept.count = 0;
        for (int i = 0; i < p.count; ++i) {
            const int j = i + 1 < p.count ? i + 1 : 0;
            const Corner &u = p.corner[i], &v = p.corner[j];
            const bool inside = height[i] >= -margin;
            (inside ? kept.corner[kept.count++] : rest.corner[rest.count++]) = u;
            if (inside != (height[j] >= -margin)) {
                if ((rows + 1) * 8 * groups > DISTANCE_ROOM)
                    return false;
                double t = height[i] / (height[i] - height[j]);
                t = t < 0.0 ? 0.0 : t > 1.0 ? 1.0 : t;
                double* row = distance + 8 * groups * rows++;
                const Corner x = {u.x + (v.x - u.x) * t, u.y + (v.y - u.y) * t, u.z + (v.z - u.z) * t, row};
                measure(x, row);
                kept.corner[kept.count++] = rest.corner[rest.count++] = x;
            }
        }
        p = kept;
        return true;
    };
    auto halve = [&](Polygon& p, Polygon& rest) {
        double longest = -1.0;
        int edge = 0;
        auto next = [&](int i) -> const Corner& { return p.corner[i + 1 < p.count ? i + 1 : 0]; };
        for (int i = 0; i < p.count; ++i) {
            const double x = next(i).x - p.corner[i].x, y = next(i).y - p.corner[i].y, z = next(i).z - p.corner[i].z;
            const double size = x * x + y * y + z * z;
            if (size > longest) {
                longest = size;
                edge = i;
            }
        }
        const Corner u = p.corner[edge], v = next(edge);
        const double way[3] = {v.x - u.x, v.y - u.y, v.z - u.z};
        const double size = wp::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        const double normal[3] = {size > 0.0 ? way[0] / size : 0.0, size > 0.0 ? way[1] / size : 0.0,
                                  size > 0.0 ? way[2] / size : 0.0};
        const double middle[3] = {u.x + way[0] * 0.5, u.y + way[1] * 0.5, u.z + way[2] * 0.5};
        return cut(p, rest, normal, middle, 0.0);
    };
    Polygon stack[POLYGON_STACK];
    // As `split_polygon`; the new top, or -1 where there is no room for distances.
    auto split = [&](Polygon& p, int top, int over, double margin) {
        FaceLanes& lane = group[over >> 3];
        const int bottom = top, i = over & 7;
        if (!lane.has_sides)
            lane.find_sides();
        for (int k = 0; k < 3 && lane.has_area[i] && p.count > 0; ++k) {
            const FaceLanes::Point &side = lane.side[k], &start = k == 0 ? lane.a : k == 1 ? lane.b : lane.c;
            const double normal[3] = {side.x[i], side.y[i], side.z[i]}, origin[3] = {start.x[i], start.y[i], start.z[i]};
            if (!cut(p, stack[top], normal, origin, margin))
                return -1;
            top += stack[top].count > 0;
        }
        if (p.count > 0)
            stack[top++] = p;
        if (top - bottom == 1) {
            Polygon whole = stack[bottom];
            if (!halve(whole, stack[bottom]))
                return -1;
            top = bottom + (stack[bottom].count > 0);
            if (whole.count > 0)
                stack[top++] = whole;
        }
        return top;
    };
    double limit = covers.limit.data[0];
    int used[COVER_SLOTS], count = 0;
    // As `cover_triangle`; false where that has to do it.
    auto cover_triangle = [&]() {
        int top = 1, cuts = 0;
        count = 0;
        while (top > 0) {
            Polygon p = stack[--top];
            double bound;
            const int best = cover(p, limit, bound);
            bool final = bound <= limit;
            if (!final) {
                double least = 0.0, here;
                for (int k = 0; k < p.count; ++k) {
                    nearest(p.corner[k].distance, here);
                    least = here > least ? here : least;
                }
                if (least > limit)
                    return false;  // another face may be nearer
                const double enough = 1.1 * least > limit ? 1.1 * least : limit;
                final = bound <= enough || cuts >= COVER_CUTS || top + 4 >= POLYGON_STACK ||
                        p.count + 4 > POLYGON_CORNERS;
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
                ++cuts;
                Corner middle = {0.0, 0.0, 0.0, nullptr};
                for (int k = 0; k < p.count; ++k) {
                    middle.x += p.corner[k].x;
                    middle.y += p.corner[k].y;
                    middle.z += p.corner[k].z;
                }
                middle.x /= p.count;
                middle.y /= p.count;
                middle.z /= p.count;
                alignas(64) double row[NEAR_ROOM];
                double here;
                measure(middle, row);
                top = split(p, top, nearest(row, here), 0x1p-46 + 0.05 * wp::sqrt(limit));
                if (top < 0)
                    return false;
            }
        }
        return true;
    };
    for (double* x = &place[0][0][0]; x != &place[0][0][0] + NEAR_ROOM * 9; ++x)
        *x = 0.0;
    for (int i = 0; i < near_count; ++i)
        add(covers.near.data[i]);
    load_groups(0);
    auto slot_at = [&](int slot) { return replay.slot.data + SLOT_FIELDS * (wp::int64)slot; };
    auto corners_of = [&](int t) { return (const double*)replay.triangle_pos.data + 9 * (wp::int64)t; };
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
        bits has_first = {};
        for (int k = 0; k < 8 && i + k < end; ++k) {
            const int first = find(covers.first.data[i + k]);
            const double* from = corners_of(covers.triangle.data[i + k]);
            has_first[k] = -(first >= 0);
            for (int x = 0; x < 9; ++x)
                corner[x][k] = from[x];
            for (int x = 0; x < 9 && first >= 0; ++x)
                over[x][k] = place[first >> 3][x][first & 7];
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
    for (int i = begin; i < end; ++i) {
        const int t = covers.triangle.data[i];
        const double start = limit;
        int* found = covers.face.data + COVER_SLOTS * (i - begin);
        if (first_bound[i - begin] <= limit) {
            covers.count.data[i - begin] = 1;
            found[0] = covers.first.data[i];
            continue;
        }
        faces = near_count;
        groups = (faces + 7) / 8;
        for (int slot = t; slot >= 0; slot = slot_at(slot)[SLOT_SIBLING]) {
            const int f = slot_at(slot)[SLOT_FACE];
            if (is_live(f) && find(f) < 0) {
                if (faces == NEAR_ROOM)
                    return i;
                add(f);
            }
        }
        if (faces == 0)
            return i;
        if (faces > near_count)
            load_groups(near_count >> 3);
        const double* corner = corners_of(t);
        stack[0].count = rows = 3;
        for (int k = 0; k < 3; ++k) {
            stack[0].corner[k] =
                Corner{corner[3 * k], corner[3 * k + 1], corner[3 * k + 2], distance + 8 * groups * k};
            measure(stack[0].corner[k], distance + 8 * groups * k);
        }
        if (!cover_triangle()) {
            covers.limit.data[0] = start;
            return i;
        }
        covers.count.data[i - begin] = count;
        for (int k = 0; k < count; ++k)
            found[k] = face[used[k]];
        covers.limit.data[0] = limit;
    }
#endif
    return end;
}
