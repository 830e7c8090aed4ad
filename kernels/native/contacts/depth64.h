// Depths of 8 face pairs that cross, as `crossing_depth` one by one: no rounding differs.
#pragma once
#include "builtin.h"
#include "contacts/contact64.h"

struct Depth64 {
    typedef Float64 F;
    typedef Contact64 C;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;

    lanes square = lanes{} - 1.0, length = {};  // of the widest gap yet

    static Point scaled(const Point& v, const lanes& s) { return Point{v.x * s, v.y * s, v.z * s}; }
    static lanes minor_exactly(const lanes& a, const lanes& b, const lanes& c, const lanes& d) {
        const lanes w = c * d;
        return F::fuse(a, b, -w) - F::fuse(c, d, -w);
    }
    static Point cross_exactly(const Point& u, const Point& v) {
        return Point{minor_exactly(u.y, v.z, u.z, v.y), minor_exactly(u.z, v.x, u.x, v.z),
                     minor_exactly(u.x, v.y, u.y, v.x)};
    }
    // The power of two at or below a size, 1 for none.
    static lanes power_of_two(const lanes& size) {
        const lanes power = __builtin_bit_cast(lanes, __builtin_bit_cast(bits, size) & 0x7FF0000000000000);
        return power > 0.0 ? power : lanes{} + 1.0;
    }
    void offer_gap(const Point& n, const lanes& low, const lanes& high) {
        const lanes gap = F::greater(-high, low), n_length = C::dot(n, n), n_square = gap * F::absolute(gap);
        const bits wider = n_square * length > square * n_length;
        square = wider ? n_square : square;
        length = wider ? n_length : length;
    }
    void offer_face(const Point& n, const Point& x, const Point& y, const Point& z) {
        const lanes p = C::dot(n, x), q = C::dot(n, y), r = C::dot(n, z);
        offer_gap(n, F::lesser(p, F::lesser(q, r)), F::greater(p, F::greater(q, r)));
    }
    void offer_edges(const Point& e, const Point& f, const lanes& a, const lanes& b, const Point& r) {
        const Point n = C::cross(e, f);
        const lanes z = C::dot(n, r), zero = {};
        offer_gap(n, z + F::lesser(b, zero) - F::greater(a, zero), z + F::greater(b, zero) - F::lesser(a, zero));
    }
    // As `Triangles`, and their edges.
    struct Scaled {
        Point a[3], b[3], e[3], f[3];
        lanes size;
    };
    // Of corners of A, and the differences of those of B and A's first one.
    static Scaled scale(const Point (&a)[3], const Point (&of_b)[3]) {
        const Point a1 = F::minus(a[1], a[0]), a2 = F::minus(a[2], a[0]);
        const lanes of_a = F::greater(C::largest(a1), C::largest(a2));
        const lanes last = F::greater(C::largest(of_b[1]), C::largest(of_b[2]));
        Scaled t;
        t.size = power_of_two(F::greater(of_a, F::greater(C::largest(of_b[0]), last)));
        const lanes scale = 1.0 / t.size;
        t.a[0] = Point{};
        t.a[1] = scaled(a1, scale);
        t.a[2] = scaled(a2, scale);
        for (int i = 0; i < 3; ++i)
            t.b[i] = scaled(of_b[i], scale);
        t.e[0] = t.a[1];
        t.e[1] = F::minus(t.a[2], t.a[1]);
        t.e[2] = C::negate(t.a[2]);
        for (int i = 0; i < 3; ++i)
            t.f[i] = F::minus(t.b[(i + 1) % 3], t.b[i]);
        return t;
    }
    static lanes measure(const Scaled& t) {
        const Point(&b)[3] = t.b, (&e)[3] = t.e, (&f)[3] = t.f;
        const Point normal_a = cross_exactly(t.a[1], t.a[2]), normal_b = cross_exactly(f[0], C::negate(f[2]));
        Depth64 best;
        best.offer_face(normal_a, b[0], b[1], b[2]);
        best.offer_face(normal_b, C::negate(b[0]), F::minus(t.a[1], b[0]), F::minus(t.a[2], b[0]));
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                best.offer_edges(e[i], f[j], -C::dot(f[j], normal_a), C::dot(e[i], normal_b),
                                 i == 0 ? b[j] : F::minus(b[j], t.a[i]));
        const bits some = best.length > 0.0;
        const lanes depth = some ? -best.square / (some ? best.length : lanes{} + 1.0) : lanes{};
        return C::root(F::greater(depth, lanes{})) * t.size;
    }
};
