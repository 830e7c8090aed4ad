// 8 faces in lanes of float64: the distance of a point to each of them, and the planes of the prism over each.
#pragma once
#include "builtin.h"
#include "base/float64.h"

struct FaceLanes {
    typedef Float64::lanes lanes;
    typedef Float64::bits bits;
    typedef Float64::Point Point;
    Point a, b, c, ab, ac, bc;
    lanes ab_sq, ac_sq, bc_sq, thin;
    // Outward normals of the edges ab, bc and ca in the face's plane, and which faces have an area; found when asked.
    Point side[3];
    bits has_area;
    bool has_sides;

    static Point spread(double x, double y, double z) { return Point{x - lanes{}, y - lanes{}, z - lanes{}}; }
    static lanes dot(const Point& u, const Point& v) { return u.x * v.x + u.y * v.y + u.z * v.z; }
    static Point cross(const Point& u, const Point& v) {
        return Point{u.y * v.z - u.z * v.y, u.z * v.x - u.x * v.z, u.x * v.y - u.y * v.x};
    }
    static Point normalize(const Point& v) {
        const lanes size = __builtin_elementwise_sqrt(dot(v, v)), none = {};
        const bits some = size > 0.0;
        return Point{some ? v.x / size : none, some ? v.y / size : none, some ? v.z / size : none};
    }
    // As wp.min without its care for NaN.
    static lanes lower(const lanes& u, const lanes& v) { return u < v ? u : v; }
    static lanes higher(const lanes& u, const lanes& v) { return u < v ? v : u; }
    // The least of all lanes.
    static double least(lanes v) {
        v = lower(v, __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3));
        v = lower(v, __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5));
        v = lower(v, __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6));
        return v[0];
    }
    // From x, y and z of the first corners, of the second and of the third, 8 each.
    void load(const double (&corner)[9][8]) {
        auto row = [&](int i) { return *(const lanes*)corner[i]; };
        a = Point{row(0), row(1), row(2)};
        b = Point{row(3), row(4), row(5)};
        c = Point{row(6), row(7), row(8)};
        ab = Float64::minus(b, a);
        ac = Float64::minus(c, a);
        bc = Float64::minus(c, b);
        ab_sq = dot(ab, ab);
        ac_sq = dot(ac, ac);
        bc_sq = dot(bc, bc);
        thin = 1.0e-12 * ab_sq * ac_sq;
        has_sides = false;
    }
    // As `segment_distance_sq`: start + along * t is the point of the edge nearest to p.
    static lanes edge_distance_sq(const Point& p, const Point& start, const Point& along, lanes t, const lanes& size) {
        const lanes zero = {}, one = zero + 1.0;
        t = size > 0.0 ? lower(higher(t / size, zero), one) : zero;
        const Point to = Float64::minus(p, Point{start.x + along.x * t, start.y + along.y * t, start.z + along.z * t});
        return dot(to, to);
    }
    // As `triangle_distance_sq`.
    lanes distance_sq(const Point& p) const {
        const Point ap = Float64::minus(p, a), bp = Float64::minus(p, b), cp = Float64::minus(p, c);
        const lanes d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp),
                    d6 = dot(ac, cp);
        const lanes vc = d1 * d4 - d3 * d2, va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, total = va + vb + vc;
        const bits at_a = (d1 <= 0.0) & (d2 <= 0.0), at_b = (d3 >= 0.0) & (d4 <= d3), at_c = (d6 >= 0.0) & (d5 <= d6);
        const bits inside = (va > 0.0) & (vb > 0.0) & (vc > 0.0) & (total > thin);
        const lanes v = vb / total, w = vc / total;
        const Point over =
            Float64::minus(p, Point{a.x + ab.x * v + ac.x * w, a.y + ab.y * v + ac.y * w, a.z + ab.z * v + ac.z * w});
        lanes found = dot(over, over);
        if (Float64::to_mask(at_a | at_b | at_c | inside) != 255) {
            const Point ca = Float64::minus(a, c);
            const lanes edges = lower(
                edge_distance_sq(p, a, ab, d1, ab_sq),
                lower(edge_distance_sq(p, b, bc, dot(bp, bc), bc_sq), edge_distance_sq(p, c, ca, dot(cp, ca), ac_sq)));
            found = inside ? found : edges;
        }
        found = at_c ? dot(cp, cp) : found;
        found = at_b ? dot(bp, bp) : found;
        return at_a ? dot(ap, ap) : found;
    }
    void find_sides() {
        const Point across = cross(ab, ac), normal = normalize(across);
        has_area = dot(across, across) > 0.0;
        side[0] = normalize(cross(normal, ab));
        side[1] = normalize(cross(normal, bc));
        side[2] = normalize(cross(normal, Float64::minus(a, c)));
        has_sides = true;
    }
};
