// The float32 filter of the CPU: 16 face pairs at a time, as `float32_filter_triangles` one by one. With a gap, 0 or
// more, it also lists those that are apart, but not by more than the gap along the normal of a plane.
#pragma once
#include "builtin.h"
#include "base/float32.h"

// Corners of 16 face pairs, whose items are given by halves, in A's frame.
struct FilterCorners {
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::Point Point;
    typedef unsigned int counts __attribute__((vector_size(64)));

    template <class PairPose>
    static void load(const void* near, const void* corners, const PairPose& pose, const F::bits& low,
                     const F::bits& high, Point (&a)[3], Point (&b)[3]) {
        const auto& r = pose.rotation32.data;
        const auto& t = pose.translation32;
        const float scale = (float)pose.scale;
        // Rows of two faces, then of six corners: the high halves of the items, and the low ones.
        alignas(64) F::sixteen face[2], corner[6];
        *(counts*)face[0] = 2 * (counts)(pose.corner_a + __builtin_shufflevector(low, high, 1, 3, 5, 7, 9, 11, 13, 15,
                                                                                 17, 19, 21, 23, 25, 27, 29, 31));
        *(counts*)face[1] = 2 * (counts)(pose.corner_b + __builtin_shufflevector(low, high, 0, 2, 4, 6, 8, 10, 12, 14,
                                                                                 16, 18, 20, 22, 24, 26, 28, 30));
        for (int i = 0; i < 2; ++i) {
            const Point c = F::gather(corners, face[i]);
            *(counts*)corner[3 * i] = 2 * (counts)c.x;
            *(counts*)corner[3 * i + 1] = 2 * (counts)c.y;
            *(counts*)corner[3 * i + 2] = 2 * (counts)c.z;
        }
        for (int k = 0; k < 3; ++k) {
            const Point p = F::gather(near, corner[k]), q = F::gather(near, corner[3 + k]);
            a[k] = Point{p.x * scale, p.y * scale, p.z * scale};
            lanes x[3];
            for (int i = 0; i < 3; ++i) {
                x[i] = F::fuse(F::every(r[i][2]), q.z, F::every(t[i]));
                x[i] = F::fuse(F::every(r[i][0]), q.x, F::fuse(F::every(r[i][1]), q.y, x[i]));
            }
            b[k] = Point{x[0] * scale, x[1] * scale, x[2] * scale};
        }
    }
};

template <class ModelPool, class StatePool, class PairPose, class Filtered>
void simd_float32_filter(const ModelPool& models, const StatePool& states, const PairPose& pose,
                         wp::vec_t<3, wp::float32> bounds, bool first_ends, wp::int32 waiting,
                         wp::array_t<wp::int64> faces, wp::array_t<wp::int64> uncertain, wp::array_t<wp::int64> apart,
                         Filtered& found) {
#pragma clang fp contract(off)
    typedef Float32 F;
    typedef F::bits bits;
    typedef F::Point Point;
    typedef int loose __attribute__((vector_size(64), aligned(4)));
    typedef wp::int64 longs __attribute__((vector_size(64)));
    const float error = bounds[0], unit = bounds[1], gap = bounds[2];
    wp::int64 *list = faces.data, *rest = uncertain.data, *beside = apart.data;
    int met = 0, open = 0, done = 0, near_count = 0;
    if (error == __builtin_inff()) {
        for (; open < waiting; ++open)
            rest[open] = list[open];
        done = waiting;
    }
    while (done < waiting && (done == 0 || met == 0 || !first_ends)) {
        const int count = waiting - done < 16 ? waiting - done : 16;
        const wp::int64* items = list + done;
        const longs lane = {0, 1, 2, 3, 4, 5, 6, 7}, some = longs{} + items[0];
        const bits low = (bits)(lane < count ? (longs) * (const loose*)items : some);
        const bits high = (bits)(lane + 8 < count ? (longs) * (const loose*)(items + 8) : some);
        auto append = [&](wp::int64* to, unsigned int which) {
#if defined(__AVX512VL__)
            const longs first = __builtin_ia32_compressdi512_mask((longs)low, longs{}, which);
            const longs second = __builtin_ia32_compressdi512_mask((longs)high, longs{}, which >> 8);
            *(loose*)to = (loose)first;
            *(loose*)(to + __builtin_popcount(which & 255)) = (loose)second;
#else
            for (int n = 0; which != 0; which &= which - 1)
                to[n++] = items[__builtin_ctz(which)];
#endif
        };
        done += count;
        Point a[3], b[3];
        FilterCorners::load(models.vertex_near.data, states.face_corner.data, pose, low, high, a, b);
        const F::Sides sides_a = F::sides_of_plane(error, unit, gap, b[0], b[1], b[2], a);
        const F::Sides sides_b = F::sides_of_plane(error, unit, gap, a[0], a[1], a[2], b);
        const unsigned int one_sided = sides_a.one_sided | sides_b.one_sided, all = (1u << count) - 1;
        const unsigned int left = ~one_sided & all;
        auto keep_near = [&](unsigned int which) {
            append(beside + near_count, which);
            near_count += __builtin_popcount(which);
        };
        if (gap >= 0.0f)
            keep_near(all & one_sided & ~(sides_a.far | sides_b.far));
        const unsigned int planes_open = sides_a.uncertain | sides_b.uncertain;
        // For coincident or nearly coincident meshes, usually every pair is uncertain here.
        if ((left & ~planes_open) == 0) {
            append(rest + open, left);
            open += __builtin_popcount(left);
            continue;
        }
        bits back_a, back_b;
        Point p1, q1, r1, p2, q2, r2;
        F::rotate(sides_a, a, back_a, p1, q1, r1);
        F::rotate(sides_b, b, back_b, p2, q2, r2);
        const F::Side s = F::side_of_plane(error, unit, p1, F::choose(back_b, r1, q1), p2, F::choose(back_a, r2, q2));
        const F::Side e = F::side_of_plane(error, unit, p1, F::choose(back_b, q1, r1), F::choose(back_a, q2, r2), p2);
        const unsigned int clear = s.above | e.above;
        const unsigned int opens = left & (planes_open | (~clear & (s.uncertain | e.uncertain)));
        const unsigned int meet = left & ~opens & ~clear;
        if (gap >= 0.0f)
            keep_near(left & ~opens & clear);
        if (opens != 0) {
            append(rest + open, opens);
            open += __builtin_popcount(opens);
        }
        // Last: those that meet take the place of pairs that were tested, perhaps of these.
        append(list + met, meet);
        met += __builtin_popcount(meet);
    }
    found.met = met;
    found.uncertain = open;
    found.apart = near_count;
    found.tested = done;
}
