// Items of 16 pairs of faces at a time, in halves: eight items each.
#pragma once
#include "builtin.h"
#include "base/float32.h"

struct FaceItems {
    typedef Float32 F;
    typedef F::bits bits;
    typedef F::Point Point;
    typedef unsigned int counts __attribute__((vector_size(64)));
    typedef F::longs longs;
    longs low, high;

    // The first item in the place of those that lack.
    __attribute__((always_inline)) FaceItems(const wp::int64* items, int count) {
        const longs lane = {0, 1, 2, 3, 4, 5, 6, 7}, some = longs{} + items[0];
        low = lane < count ? *(const F::loose_longs*)items : some;
        high = lane + 8 < count ? *(const F::loose_longs*)(items + 8) : some;
    }
    // Put what a mask names behind a list, of which so many more places are written over; return how many.
    __attribute__((always_inline)) int append(wp::int64* list, unsigned int which) const {
        F::append(list, low, high, which);
        return __builtin_popcount(which);
    }
    // Corners, each in the frame of its own model.
    template <class Trees, class PairPose>
    __attribute__((always_inline)) void gather(const Trees& trees, const PairPose& pose, Point (&a)[3],
                                               Point (&b)[3]) const {
        const bits first = (bits)low, second = (bits)high;
        // Rows of two faces, then of six corners: the high halves of the items, and the low ones.
        alignas(64) F::sixteen face[2], corner[6];
        *(counts*)face[0] = 2 * (counts)(pose.corner_a + __builtin_shufflevector(first, second, 1, 3, 5, 7, 9, 11, 13,
                                                                                 15, 17, 19, 21, 23, 25, 27, 29, 31));
        *(counts*)face[1] = 2 * (counts)(pose.corner_b + __builtin_shufflevector(first, second, 0, 2, 4, 6, 8, 10, 12,
                                                                                 14, 16, 18, 20, 22, 24, 26, 28, 30));
        for (int i = 0; i < 2; ++i) {
            const Point c = F::gather(trees.states.face_corner.data, face[i]);
            *(counts*)corner[3 * i] = 2 * (counts)c.x;
            *(counts*)corner[3 * i + 1] = 2 * (counts)c.y;
            *(counts*)corner[3 * i + 2] = 2 * (counts)c.z;
        }
        for (int k = 0; k < 3; ++k) {
            a[k] = F::gather(trees.models.vertex_near.data, corner[k]);
            b[k] = F::gather(trees.models.vertex_near.data, corner[3 + k]);
        }
    }
};
