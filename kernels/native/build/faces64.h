// A face in float64, or 8 in lanes: the distance of a point to each, and the planes of the prism over each.
#pragma once
#include "builtin.h"
#include "base/float64.h"
#include "build/polygon.h"

inline bool are_all(bool flag) { return flag; }
inline bool are_all(const Lanes64::bits& flags) { return Float64::to_mask(flags) == 255; }
inline double lane_of(double v, int) { return v; }
inline bool lane_of(bool flag, int) { return flag; }
inline double lane_of(const Lanes64::lanes& v, int i) { return v[i]; }
inline bool lane_of(const Lanes64::bits& flags, int i) { return flags[i] != 0; }

template <class Number>
struct Faces64 : Points64<Number> {
    typedef Points64<Number> F;
    typedef typename F::lanes lanes;
    typedef typename F::bits bits;
    typedef typename F::Point Point;
    using F::cross, F::dot, F::greater, F::lesser, F::minus;
    Point a, b, c, ab, ac, bc;
    lanes ab_sq, ac_sq, bc_sq, thin;
    // Outward normals of the edges ab, bc and ca in the face's plane, and which faces have an area; found when asked.
    Point side[3];
    bits has_area;
    bool has_sides;

    static Point normalize(const Point& v) {
        const lanes size = F::root(dot(v, v));
        return F::choose(size > 0.0, F::divide(v, size), Point{});
    }
    void load(const Point& first, const Point& second, const Point& third) {
        a = first;
        b = second;
        c = third;
        ab = minus(b, a);
        ac = minus(c, a);
        bc = minus(c, b);
        ab_sq = dot(ab, ab);
        ac_sq = dot(ac, ac);
        bc_sq = dot(bc, bc);
        thin = 1.0e-12 * ab_sq * ac_sq;
        has_sides = false;
    }
    // start + along * t is the point of the edge nearest to p.
    static lanes edge_distance_sq(const Point& p, const Point& start, const Point& along, lanes t, const lanes& size) {
        const lanes zero = {}, one = zero + 1.0;
        t = size > 0.0 ? lesser(one, greater(t / size, zero)) : zero;
        const Point to = minus(p, Point{start.x + along.x * t, start.y + along.y * t, start.z + along.z * t});
        return dot(to, to);
    }
    // Never less than the true one up to rounding: a triangle too thin for accurate barycentric coordinates is measured
    // by its edges. Source: Ericson, Real-Time Collision Detection, section 5.1.5.
    lanes distance_sq(const Point& p) const {
        const Point ap = minus(p, a), bp = minus(p, b), cp = minus(p, c);
        const lanes d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp),
                    d6 = dot(ac, cp);
        const bits at_a = (d1 <= 0.0) & (d2 <= 0.0), at_b = (d3 >= 0.0) & (d4 <= d3), at_c = (d6 >= 0.0) & (d5 <= d6);
        if (F::is_all(at_a))
            return dot(ap, ap);
        if (F::is_all(at_b))
            return dot(bp, bp);
        const lanes vc = d1 * d4 - d3 * d2, va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, total = va + vb + vc;
        const bits inside = (va > 0.0) & (vb > 0.0) & (vc > 0.0) & (total > thin);
        const lanes v = vb / total, w = vc / total;
        const Point over =
            minus(p, Point{a.x + ab.x * v + ac.x * w, a.y + ab.y * v + ac.y * w, a.z + ab.z * v + ac.z * w});
        lanes found = dot(over, over);
        const bits known = at_a | at_b | at_c | inside;
        if (!are_all(known)) {
            const Point ca = minus(a, c);
            const lanes of_bc = edge_distance_sq(p, b, bc, dot(bp, bc), bc_sq);
            const lanes of_ca = edge_distance_sq(p, c, ca, dot(cp, ca), ac_sq);
            const lanes edges = lesser(lesser(of_ca, of_bc), edge_distance_sq(p, a, ab, d1, ab_sq));
            found = inside ? found : edges;
        }
        found = at_c ? dot(cp, cp) : found;
        found = at_b ? dot(bp, bp) : found;
        return at_a ? dot(ap, ap) : found;
    }
    // The sides of the prism over the face of a lane, and how many there are: none over one without area.
    int find_sides(int i, Plane (&plane)[3]) {
        if (!has_sides) {
            const Point across = cross(ab, ac), normal = normalize(across);
            has_area = dot(across, across) > 0.0;
            side[0] = normalize(cross(normal, ab));
            side[1] = normalize(cross(normal, bc));
            side[2] = normalize(cross(normal, minus(a, c)));
            has_sides = true;
        }
        for (int k = 0; k < 3; ++k) {
            const Point &n = side[k], &start = k == 0 ? a : k == 1 ? b : c;
            plane[k] = Plane{{lane_of(n.x, i), lane_of(n.y, i), lane_of(n.z, i)},
                             {lane_of(start.x, i), lane_of(start.y, i), lane_of(start.z, i)}};
        }
        return lane_of(has_area, i) ? 3 : 0;
    }
};

typedef Faces64<Lanes64> FaceLanes;
typedef Faces64<Number64> OneFace;
