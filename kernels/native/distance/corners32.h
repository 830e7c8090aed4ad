// Corners of 16 pairs of faces at a time, for `NearestFaces`.
#pragma once
#include "builtin.h"
#include "distance/faces32.h"

struct NearestCorners {
    typedef NearestFaces N;
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    typedef unsigned int counts __attribute__((vector_size(64)));
    typedef wp::int64 longs __attribute__((vector_size(64)));
    typedef int loose __attribute__((vector_size(64), aligned(4)));
    // The corners of up to 16 pairs of faces in A's frame, scaled; the first pair in the place of those that lack.
    static N::Corners load(const void* near, const void* ids, int start_a, int start_b, const wp::float32 (&r)[3][3],
                           const wp::vec_t<3, float>& there, float scale, const wp::int64* items, int count) {
        const longs lane = {0, 1, 2, 3, 4, 5, 6, 7}, some = longs{} + items[0];
        const bits low = (bits)(lane < count ? (longs) * (const loose*)items : some);
        const bits high = (bits)(lane + 8 < count ? (longs) * (const loose*)(items + 8) : some);
        alignas(64) F::sixteen face[2], corner[6];
        const bits of_a = __builtin_shufflevector(low, high, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
        const bits of_b = __builtin_shufflevector(low, high, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        *(counts*)face[0] = 2 * (counts)(start_a + of_a);
        *(counts*)face[1] = 2 * (counts)(start_b + of_b);
        for (int i = 0; i < 2; ++i) {
            const Point c = F::gather(ids, face[i]);
            *(counts*)corner[3 * i] = 2 * (counts)c.x;
            *(counts*)corner[3 * i + 1] = 2 * (counts)c.y;
            *(counts*)corner[3 * i + 2] = 2 * (counts)c.z;
        }
        N::Corners c;
        for (int k = 0; k < 3; ++k) {
            const Point p = F::gather(near, corner[k]);
            const Point q = F::gather(near, corner[3 + k]);
            c.a[k] = Point{p.x * scale, p.y * scale, p.z * scale};
            lanes x[3];
            for (int i = 0; i < 3; ++i) {
                x[i] = F::fuse(F::every(r[i][2]), q.z * scale, F::every(there[i]));
                x[i] = F::fuse(F::every(r[i][1]), q.y * scale, x[i]);
                x[i] = F::fuse(F::every(r[i][0]), q.x * scale, x[i]);
            }
            c.b[k] = Point{x[0], x[1], x[2]};
        }
        return c;
    }
};
