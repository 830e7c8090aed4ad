// Corners of 16 pairs of faces at a time, for `NearestFaces`.
#pragma once
#include "builtin.h"
#include "distance/faces32.h"
#include "triangle/face_items.h"

struct NearestCorners {
    typedef NearestFaces N;
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    // The corners of up to 16 pairs of faces in A's frame, scaled; the first pair in the place of those that lack.
    template <class Trees, class PairPose>
    static N::Corners load(const Trees& trees, const PairPose& pose, const wp::vec3& there, float scale,
                           const wp::int64* items, int count) {
        const auto& r = pose.rotation32.data;
        N::Corners c;
        FaceItems(items, count).gather(trees, pose, c.a, c.b);
        for (int k = 0; k < 3; ++k) {
            const Point p = c.a[k], q = c.b[k];
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
