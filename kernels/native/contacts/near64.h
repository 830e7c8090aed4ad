// Nearest points of 8 face pairs that are apart, as `nearest_features` one by one: no rounding differs.
#pragma once
#include "builtin.h"
#include "contacts/contact64.h"
#include "triangle/gap.cuh"

typedef WidestGap<Lanes64> Gap64;

struct Near64 {
    typedef Float64 F;
    typedef Contact64 C;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;

    // Of the nearest yet: its distance, squared, and the weights of the corners of A and of B.
    lanes square = lanes{} + __builtin_inf();
    lanes of_a[3], of_b[3];

    static Point scaled(const Point& v, const lanes& s) { return Point{v.x * s, v.y * s, v.z * s}; }
    // The power of two at or below a size, 1 for none.
    static lanes power_of_two(const lanes& size) {
        const lanes power = __builtin_bit_cast(lanes, __builtin_bit_cast(bits, size) & 0x7FF0000000000000);
        return power > 0.0 ? power : lanes{} + 1.0;
    }
    // Of corners of A, and the differences of those of B and A's first one.
    static Gap64::Scaled scale(const Point (&a)[3], const Point (&of_b)[3]) {
        const Point a1 = F::minus(a[1], a[0]), a2 = F::minus(a[2], a[0]);
        const lanes of_a = F::greater(C::largest(a1), C::largest(a2));
        const lanes last = F::greater(C::largest(of_b[1]), C::largest(of_b[2]));
        Gap64::Scaled t;
        t.size = power_of_two(F::greater(of_a, F::greater(C::largest(of_b[0]), last)));
        const lanes scale = 1.0 / t.size;
        t.a[0] = Point{};
        t.a[1] = scaled(a1, scale);
        t.a[2] = scaled(a2, scale);
        for (int i = 0; i < 3; ++i)
            t.b[i] = scaled(of_b[i], scale);
        t.find_edges();
        return t;
    }
    static lanes clamp_unit(const lanes& x) { return F::lesser(F::greater(x, lanes{}), lanes{} + 1.0); }
    static lanes divide(const lanes& a, const lanes& b) {
        const bits some = b > 0.0;
        return some ? a / (some ? b : lanes{} + 1.0) : lanes{};
    }
    static Point plus(const Point& a, const Point& b) { return Point{a.x + b.x, a.y + b.y, a.z + b.z}; }
    static Point sum(const lanes (&weight)[3], const Point (&corner)[3]) {
        return plus(plus(scaled(corner[0], weight[0]), scaled(corner[1], weight[1])), scaled(corner[2], weight[2]));
    }
    void offer(const lanes& found, const lanes (&a)[3], const lanes (&b)[3]) {
        const bits closer = found < square;
        square = closer ? found : square;
        for (int k = 0; k < 3; ++k) {
            of_a[k] = closer ? a[k] : of_a[k];
            of_b[k] = closer ? b[k] : of_b[k];
        }
    }
    // Weights at a parameter of edge i.
    static void weigh_edge(int i, const lanes& s, lanes (&weight)[3]) {
        weight[i] = 1.0 - s;
        weight[(i + 1) % 3] = s;
        weight[(i + 2) % 3] = lanes{};
    }
    // Edges p + s e of A and q + t f of B.
    void offer_edges(int i, int j, const Point& p, const Point& e, const Point& q, const Point& f) {
        const Point r = F::minus(q, p), n = C::cross(e, f);
        lanes s = clamp_unit(divide(C::dot(C::cross(r, f), n), C::dot(n, n)));
        const lanes t = clamp_unit(divide(C::dot(F::minus(scaled(e, s), r), f), C::dot(f, f)));
        s = clamp_unit(divide(C::dot(plus(scaled(f, t), r), e), C::dot(e, e)));
        const Point v = F::minus(plus(r, scaled(f, t)), scaled(e, s));
        lanes a[3], b[3];
        weigh_edge(i, s, a);
        weigh_edge(j, t, b);
        offer(C::dot(v, v), a, b);
    }
    // Corner i of one face, w from the first of the other, whose edges from there are e1 and e2.
    void offer_corner(int i, bool is_of_b, const Point& w, const Point& e1, const Point& e2, const Point& n) {
        const lanes nn = C::dot(n, n);
        const Point level = F::minus(w, scaled(n, divide(C::dot(w, n), nn)));
        const lanes x = divide(C::dot(Gap64::cross_exactly(level, e2), n), nn);
        const lanes y = divide(C::dot(Gap64::cross_exactly(e1, level), n), nn);
        const Point v = F::minus(F::minus(w, scaled(e1, x)), scaled(e2, y));
        const bits inside = (nn > 0.0) & (x >= 0.0) & (y >= 0.0) & (x + y <= 1.0);
        const lanes face[3] = {(1.0 - x) - y, x, y};
        const lanes found = inside ? C::dot(v, v) : lanes{} + __builtin_inf();
        lanes corner[3];
        weigh_edge(i, lanes{}, corner);
        if (is_of_b)
            offer(found, face, corner);
        else
            offer(found, corner, face);
    }
    void search(const Gap64::Scaled& t) {
        const Point(&b)[3] = t.b, (&e)[3] = t.e, (&f)[3] = t.f;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                offer_edges(i, j, t.a[i], e[i], b[j], f[j]);
        const Point back = C::negate(f[2]), normal_a = Gap64::cross_exactly(t.a[1], t.a[2]);
        const Point normal_b = Gap64::cross_exactly(f[0], back);
        for (int i = 0; i < 3; ++i) {
            offer_corner(i, true, b[i], t.a[1], t.a[2], normal_a);
            offer_corner(i, false, i == 0 ? C::negate(b[0]) : F::minus(t.a[i], b[0]), f[0], back, normal_b);
        }
    }
    // As `between_features`.
    Point find_way(const Gap64::Scaled& t) const {
        return F::minus(sum(of_b, t.b), plus(scaled(t.a[1], of_a[1]), scaled(t.a[2], of_a[2])));
    }
};
