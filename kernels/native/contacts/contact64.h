// Arithmetic of contacts in 8 lanes, as functions of the same names one by one: no rounding differs.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "contacts/double64.h"

struct Contact64 {
    typedef Float64 F;
    typedef Double64 D;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;

    // Ends of edges in order, as `order_ends` says: 1 and -1.
    struct Order {
        bits after, before;
    };

    static Point negate(const Point& v) { return Point{-v.x, -v.y, -v.z}; }
    static lanes dot(const Point& a, const Point& b) { return (a.x * b.x + a.y * b.y) + a.z * b.z; }
    static lanes largest(const Point& v) {
        const lanes x = F::absolute(v.x), y = F::absolute(v.y), z = F::absolute(v.z);
        const lanes m = x >= y ? x : y;
        return m >= z ? m : z;
    }
    static Point divide(const Point& v, const lanes& s) { return Point{v.x / s, v.y / s, v.z / s}; }
    static lanes root(const lanes& x) { return __builtin_elementwise_sqrt(x); }
    static lanes measure_length(const Point& v) {
        const lanes m = largest(v);
        const Point u = divide(v, m);
        return m == 0.0 ? m : m * root(dot(u, u));
    }
    static Point unit_vector(const Point& v) {
        const lanes m = largest(v);
        const Point u = divide(v, m);
        return F::choose(m == 0.0, v, divide(u, root(dot(u, u))));
    }
    // By columns, as Warp multiplies.
    static Point turn(const double (&m)[3][3], const Point& v) {
        return Point{(m[0][0] * v.x + m[0][1] * v.y) + m[0][2] * v.z, (m[1][0] * v.x + m[1][1] * v.y) + m[1][2] * v.z,
                     (m[2][0] * v.x + m[2][1] * v.y) + m[2][2] * v.z};
    }
    static Point pose(const double (&m)[3][3], const wp::vec_t<3, wp::float64>& t, const Point& p) {
        const Point v = turn(m, p);
        const lanes x = v.x + t[0], y = v.y + t[1], z = v.z + t[2];
        return Point{F::absolute(x) < COORDINATE_MIN ? lanes{} : x, F::absolute(y) < COORDINATE_MIN ? lanes{} : y,
                     F::absolute(z) < COORDINATE_MIN ? lanes{} : z};
    }
    // As `round_volume`, of differences, and the sum of magnitudes.
    static lanes volume(const Point& u, const Point& v, const Point& w, lanes& size) {
        const lanes v1w2 = v.y * w.z, v2w1 = v.z * w.y, w1u2 = w.y * u.z, w2u1 = w.z * u.y;
        const lanes u1v2 = u.y * v.z, u2v1 = u.z * v.y;
        size = F::absolute(u.x) * (F::absolute(v1w2) + F::absolute(v2w1));
        size = size + F::absolute(v.x) * (F::absolute(w1u2) + F::absolute(w2u1));
        size = size + F::absolute(w.x) * (F::absolute(u1v2) + F::absolute(u2v1));
        return (u.x * (v1w2 - v2w1) + v.x * (w1u2 - w2u1)) + w.x * (u1v2 - u2v1);
    }
    // As `filter_volumes`, or without double words where it does not extend: of triangle (a, b, c) and d, with u, v and
    // w their differences, perhaps all turned round. Adds the lanes that it is not sure of to a mask.
    static lanes filter_volume(bool extends, const Point (&c)[3], const Point& d, const Point& u, const Point& v,
                               const Point& w, bits& unsure) {
        lanes size, value = volume(u, v, w, size);
        bits open = BOUND_3D * size > RELATIVE_ERROR * F::absolute(value);
        if (__builtin_expect(extends && F::to_mask(open) != 0, 0))
            value = D::round(D::orient3d(c[0], c[1], c[2], d), BOUND_DOUBLE * size, value, open);
        unsure |= open;
        return value;
    }
    // As `filter_normal`, in the same way.
    static lanes filter_area(bool extends, const lanes& ax, const lanes& ay, const lanes& bx, const lanes& by,
                             const lanes& cx, const lanes& cy, bits& unsure) {
        const lanes left = (ax - cx) * (by - cy), right = (ay - cy) * (bx - cx);
        const lanes size = F::absolute(left) + F::absolute(right);
        lanes value = left - right;
        bits open = BOUND_2D * size > RELATIVE_ERROR * F::absolute(value);
        if (__builtin_expect(extends && F::to_mask(open) != 0, 0))
            value = D::round(D::orient2d(ax, ay, bx, by, cx, cy), BOUND_DOUBLE * size, value, open);
        unsure |= open;
        return value;
    }
    static Point filter_normal(bool extends, const Point& a, const Point& b, const Point& c, bits& unsure) {
        return unit_vector(Point{filter_area(extends, a.y, a.z, b.y, b.z, c.y, c.z, unsure),
                                 filter_area(extends, a.z, a.x, b.z, b.x, c.z, c.x, unsure),
                                 filter_area(extends, a.x, a.y, b.x, b.y, c.x, c.y, unsure)});
    }
    static Order order_ends(const Point& p1, const Point& e1, const Point& p2, const Point& e2, bits& open) {
        const Point u = F::minus(p1, e2), v = F::minus(e1, e2), w = F::minus(p2, e2);
        const F::Sign sign = F::determinant(u, v, w, F::sizes(u), F::sizes(v), F::sizes(w));
        const lanes bound = BOUND_3D * sign.size;
        const Order order = {sign.value > bound, sign.value < -bound};
        open |= ~(order.after | order.before) & (bound != 0.0);
        return order;
    }
    // As `rotate_triangles`: corners and their volumes from the lone one on, in either direction.
    static void rotate(const bits& first, const bits& second, const bits& back, const Point (&c)[3],
                       const lanes (&x)[3], Point& p, Point& q, Point& r, lanes& of_p, lanes& of_q, lanes& of_r) {
        p = F::choose(first, c[0], F::choose(second, c[1], c[2]));
        of_p = first ? x[0] : second ? x[1] : x[2];
        const Point next = F::choose(first, c[1], F::choose(second, c[2], c[0]));
        const Point last = F::choose(first, c[2], F::choose(second, c[0], c[1]));
        const lanes of_next = first ? x[1] : second ? x[2] : x[0], of_last = first ? x[2] : second ? x[0] : x[1];
        q = F::choose(back, last, next);
        r = F::choose(back, next, last);
        of_q = back ? of_last : of_next;
        of_r = back ? of_next : of_last;
    }
    static Point cross_edge(const Point& p, const Point& q, const lanes& value_p, const lanes& value_q) {
        const lanes part = value_p / (value_p - value_q);
        const Point way = F::minus(q, p);
        return Point{p.x + way.x * part, p.y + way.y * part, p.z + way.z * part};
    }
    static Point blend_normals(const Point& normal_a, const Point& normal_b) {
        const Point normal = F::minus(normal_a, normal_b);
        return unit_vector(F::choose(dot(normal, normal) <= SHORTEST_NORMAL * SHORTEST_NORMAL, normal_a, normal));
    }
    static Point cross(const Point& a, const Point& b) {
        return Point{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    }
    // 1 where faces intersect, 0 where a gap lies between them.
    static void load_crossed(const double* separation, bool with_gap, int first, int count, lanes& crossed) {
        crossed = lanes{} + 1.0;
        for (int k = 0; k < (with_gap ? count : 0); ++k)
            crossed[k] = separation[first + k] < 0.0 ? 1.0 : 0.0;
    }
    // So many points, of 24 numbers, one point after the other; 0 behind them.
    static Point load(const double* numbers, int count) {
        typedef double loose __attribute__((vector_size(64), aligned(8)));
        double few[24] = {};
        if (__builtin_expect(count < 8, 0)) {
            for (int k = 0; k < 3 * count; ++k)
                few[k] = numbers[k];
            numbers = few;
        }
        const lanes a = *(const loose*)numbers, b = *(const loose*)(numbers + 8), c = *(const loose*)(numbers + 16);
        const lanes x_ab = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 0, 0);
        const lanes y_ab = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 1, 1, 1);
        const lanes z_ab = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 2, 2, 2);
        return Point{__builtin_shufflevector(x_ab, c, 0, 1, 2, 3, 4, 5, 10, 13),
                     __builtin_shufflevector(y_ab, c, 0, 1, 2, 3, 4, 8, 11, 14),
                     __builtin_shufflevector(z_ab, c, 0, 1, 2, 3, 4, 9, 12, 15)};
    }
    // Points as such numbers.
    static void store(double* numbers, const Point& p) {
        typedef double loose __attribute__((vector_size(64), aligned(8)));
        const lanes xy_low = __builtin_shufflevector(p.x, p.y, 0, 8, 1, 9, 2, 10, 3, 11);
        const lanes xy_high = __builtin_shufflevector(p.x, p.y, 4, 12, 5, 13, 6, 14, 7, 15);
        const lanes xy_middle = __builtin_shufflevector(p.x, p.y, 10, 3, 11, 4, 12, 5, 13, 6);
        *(loose*)numbers = __builtin_shufflevector(xy_low, p.z, 0, 1, 8, 2, 3, 9, 4, 5);
        *(loose*)(numbers + 8) = __builtin_shufflevector(xy_middle, p.z, 10, 1, 2, 11, 3, 4, 12, 5);
        *(loose*)(numbers + 16) = __builtin_shufflevector(xy_high, p.z, 3, 13, 4, 5, 14, 6, 7, 15);
    }
};
