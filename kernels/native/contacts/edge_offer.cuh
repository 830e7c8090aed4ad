// Points of large faces at which their edges cross or end, for slots: of one pair of faces in each thread of a GPU, of
// 16 on the CPU.
#pragma once
#include "builtin.h"
#include "distance/faces32.h"

template <class Scores>
struct EdgeOffer {
    typedef NearestFaces N;
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;

    static CUDA_CALLABLE typename Scores::Vector vector_of(const Point& p) { return {p.x, p.y, p.z}; }
    // Hands over each edge of A, its start, what leads from there to the start of one of B, and that.
    template <class Take>
    static CUDA_CALLABLE void visit_edges(N::Corners c, const Take& take) {
        // One edge of A after the other, so that a GPU needs no stack.
#pragma unroll 1
        for (int i = 0; i < 3; ++i) {
            const Point first = c.a[0], e = F::minus(c.a[1], first);
            for (int j = 0; j < 3; ++j)
                take(first, e, F::minus(c.b[j], first), F::minus(c.b[(j + 1) % 3], c.b[j]));
            c.a[0] = c.a[1];
            c.a[1] = c.a[2];
            c.a[2] = first;
        }
    }
    // Rates the points over one another of edges that cross, seen along a normal: corners of what faces share. None is
    // nearer than the faces, as seen aslant it would be.
    static CUDA_CALLABLE void offer_crossings(const N::Corners& c, const Point& normal, float gap, float weight,
                                              const lanes& distance, const lanes& slack, const bits& counts,
                                              Scores& scores) {
        visit_edges(c, [&](const Point& p, const Point& e, const Point& r, const Point& f) {
            lanes s;
            const Point v = N::between_edges(r, e, f, F::invert(F::dot(e, e)), F::invert(F::dot(f, f)), s);
            const lanes height = F::dot(v, normal), square = height * height;
            const bits over = F::dot(v, v) <= F::fuse(square, lanes{} + (1.0f + 0x1p-6f), slack * slack);
            const bits near = (height <= gap) & (height >= -gap);
            scores.offer(weight, vector_of(N::add(p, s, e)), F::most(height, distance), counts & over & near);
        });
    }
    // Rates the ends of what edges share that are parallel: the nearest points from either end of one.
    static CUDA_CALLABLE void offer_ends(const N::Corners& c, float weight, const lanes& most, const bits& counts,
                                         Scores& scores) {
        visit_edges(c, [&](const Point& p, const Point& e, const Point& r, const Point& f) {
            for (int k = 0; k < 2; ++k) {
                const lanes t = N::clamp((F::dot(e, f) * (float)k - F::dot(r, f)) * F::invert(F::dot(f, f)));
                const Point way = N::add(r, t, f);
                const lanes s = N::clamp(F::dot(way, e) * F::invert(F::dot(e, e)));
                const Point v = N::add(way, -s, e);
                const lanes distance = F::root(F::dot(v, v));
                scores.offer(weight, vector_of(N::add(N::add(p, s, e), lanes{} + 0.5f, v)), distance,
                             counts & (distance <= most));
            }
        });
    }
};
