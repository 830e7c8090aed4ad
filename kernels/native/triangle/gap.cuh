// The widest gap that a direction leaves between two triangles: of one pair in a thread, of 8 on the CPU.
#pragma once
#include "builtin.h"
#include "base/points64.cuh"

template <class Number>
struct WidestGap : Points64<Number> {
    typedef Points64<Number> F;
    typedef typename F::lanes lanes;
    typedef typename F::bits bits;
    typedef typename F::Point Point;
    using F::dot, F::greater, F::lesser, F::minus, F::negate;

    // Corners as of `Triangles`, and the edges from each to the next.
    struct Scaled {
        Point a[3], b[3], e[3], f[3];
        lanes size;
        CUDA_CALLABLE void find_edges() {
            for (int i = 0; i < 3; ++i)
                f[i] = minus(b[(i + 1) % 3], b[i]);
            e[0] = a[1];
            e[1] = minus(a[2], a[1]);
            e[2] = negate(a[2]);
        }
    };
    // A square that keeps its sign, over the square of a direction's length: below 0 / 0 there is none.
    lanes square = lanes{} - 1.0, length = {};
    Point direction;  // from A to B

    static CUDA_CALLABLE lanes minor_exactly(const lanes& a, const lanes& b, const lanes& c, const lanes& d) {
        const lanes w = lanes{} - c * d;  // no zero has a sign
        return F::fuse(a, b, w) - F::fuse(c, d, w);
    }
    static CUDA_CALLABLE Point cross_exactly(const Point& u, const Point& v) {
        return Point{minor_exactly(u.y, v.z, u.z, v.y), minor_exactly(u.z, v.x, u.x, v.z),
                     minor_exactly(u.x, v.y, u.y, v.x)};
    }
    // The gap along n, of which B lies from low to high if A is at 0.
    CUDA_CALLABLE void offer(const Point& n, const lanes& low, const lanes& high) {
        const lanes gap = greater(-high, low), n_length = dot(n, n), n_square = gap * F::absolute(gap);
        const bits wider = n_square * length > square * n_length;
        square = wider ? n_square : square;
        length = wider ? n_length : length;
        direction = F::choose(wider, F::choose(low >= -high, n, negate(n)), direction);
    }
    // Across a face of A: x, y and z are the other's corners relative to a corner of it.
    CUDA_CALLABLE void offer_face(const Point& n, const Point& x, const Point& y, const Point& z) {
        const lanes p = dot(n, x), q = dot(n, y), r = dot(n, z);
        offer(n, lesser(p, lesser(q, r)), greater(p, greater(q, r)));
    }
    // Along n across an edge of each face: the corners opposite of the edges lie at a and b from them along n, and the
    // second edge starts at r from the start of the first. A lies from 0 to a, B from z to z + b.
    CUDA_CALLABLE void offer_edges(const Point& n, const lanes& a, const lanes& b, const Point& r) {
        const lanes z = dot(n, r), zero = {};
        offer(n, z + lesser(b, zero) - greater(a, zero), z + greater(b, zero) - lesser(a, zero));
    }
    // Of all directions: a normal of either face, or one across an edge of each. Of triangles that intersect the motion
    // that parts them is never too short but for a few roundings, and too long by at most 2^-26 of the size where edges
    // are nearly parallel, as the direction across them errs then.
    CUDA_CALLABLE explicit WidestGap(const Scaled& t) : direction(Point{}) {
        const Point(&b)[3] = t.b, (&e)[3] = t.e, (&f)[3] = t.f;
        const Point normal_a = cross_exactly(t.a[1], t.a[2]), normal_b = cross_exactly(f[0], negate(f[2]));
        offer_face(normal_a, b[0], b[1], b[2]);
        // Seen from B, A lies on the other side.
        offer_face(negate(normal_b), b[0], minus(b[0], t.a[1]), minus(b[0], t.a[2]));
        // Of e x f, the corner opposite of e lies by -f . normal_a; that of f by e . normal_b.
#pragma unroll
        for (int i = 0; i < 3; ++i)
#pragma unroll
            for (int j = 0; j < 3; ++j)
                offer_edges(F::cross(e[i], f[j]), -dot(f[j], normal_a), dot(e[i], normal_b),
                            i == 0 ? b[j] : minus(b[j], t.a[i]));
    }
    // The shortest motion that parts triangles which intersect. Along one line there is no such direction, and any
    // across it parts them.
    CUDA_CALLABLE lanes depth() const {
        const bits some = length > 0.0;
        const lanes square_depth = some ? -square / (some ? length : lanes{} + 1.0) : lanes{};
        return F::root(greater(square_depth, lanes{}));
    }
};

template <class Triangles>
CUDA_CALLABLE wp::float64 find_depth(const Triangles& t, wp::vec3d& direction) {
    WidestGap<Number64>::Scaled scaled = {{{}, point_of(t.a1), point_of(t.a2)},
                                          {point_of(t.b0), point_of(t.b1), point_of(t.b2)}};
    scaled.find_edges();
    const WidestGap<Number64> widest(scaled);
    direction = vector_of(widest.direction);
    return widest.depth();
}
