// Signs of determinants of face pairs in float32, with bounds of their errors: of one pair in each thread of a GPU, of
// 16 on the CPU.
#pragma once
#include "builtin.h"
#include "base/float32.h"
#include "base/sizes.h"

struct PlaneFilter {
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    // Of three points over a plane, and what they err by.
    struct Heights {
        lanes value[3], bound;
    };
    float error, unit;

    // Bound the error of a determinant whose rows have these sums of magnitudes.
    CUDA_CALLABLE lanes bound_error(const lanes& u, const lanes& v, const lanes& w) const {
        const lanes p = u + 2.0f * error, q = v + 2.0f * error, s = w + 2.0f * error;
        return error * (p * q + s * (p + q)) + unit * (p * q * s);
    }
    // Of a plane through a corner, u and v from it to the two others; w from the points to that corner.
    CUDA_CALLABLE Heights over_plane(const Point& u, const Point& v, const Point& w0, const Point& w1,
                                     const Point& w2) const {
        const Point normal = F::cross(u, v);
        const lanes far = F::largest(F::sum_sizes(w0), F::sum_sizes(w1), F::sum_sizes(w2));
        return Heights{{F::dot(w0, normal), F::dot(w1, normal), F::dot(w2, normal)},
                       bound_error(F::sum_sizes(u), F::sum_sizes(v), far)};
    }
    // Of the corners of A over the plane of B, and of those of B over that of A.
    CUDA_CALLABLE void compare_planes(const Point (&a)[3], const Point (&b)[3], Heights& of_a, Heights& of_b) const {
        const Point w = F::minus(b[0], a[0]), back = {-w.x, -w.y, -w.z};
        of_a = over_plane(F::minus(b[1], b[0]), F::minus(b[2], b[0]), w, F::minus(b[0], a[1]), F::minus(b[0], a[2]));
        of_b = over_plane(F::minus(a[1], a[0]), F::minus(a[2], a[0]), back, F::minus(a[0], b[1]), F::minus(a[0], b[2]));
    }
    // Beyond which points are farther than a gap from the plane of corners: docs/exactness.md, bound 23. Squares may
    // underflow.
    CUDA_CALLABLE lanes widen(const lanes& bound, float gap, const Point (&c)[3]) const {
        const Point u = F::minus(c[1], c[0]), v = F::minus(c[2], c[0]), normal = F::cross(u, v);
        const lanes p = F::sum_sizes(u) + 2.0f * error, q = F::sum_sizes(v) + 2.0f * error;
        const lanes most = F::sum_sizes(normal), root = F::root(F::dot(normal, normal));
        const lanes length = (most > 0x1p-50f ? root : most) + 2.0f * (error * (p + q) + unit * (p * q));
        return (bound + gap * length) * (1.0f + 0x1p-18f);
    }
    // Whether the corners of B are farther than a gap from A along the normal of one of its edges in its plane, that
    // which the first lies farthest beyond: docs/exactness.md, bound 24.
    CUDA_CALLABLE bits are_beyond_edge(const Point (&a)[3], const Point (&b)[3], float gap) const {
        const Point u = F::minus(a[1], a[0]), v = F::minus(a[2], a[0]), normal = F::cross(u, v);
        const Point w0 = F::minus(b[0], a[0]), w1 = F::minus(b[1], a[0]), w2 = F::minus(b[2], a[0]);
        const Point of_u = F::cross(u, normal), of_v = F::cross(normal, v);
        const lanes over_u = F::dot(w0, of_u), over_v = F::dot(w0, of_v);
        const lanes over_third = -(over_u + over_v) - F::dot(normal, normal);
        const Point third = {-(of_u.x + of_v.x), -(of_u.y + of_v.y), -(of_u.z + of_v.z)};
        const Point m = F::choose(over_third > F::most(over_u, over_v), third, F::choose(over_u > over_v, of_u, of_v));
        const lanes lowest = F::least(F::dot(w0, m), F::least(F::dot(w1, m), F::dot(w2, m)));
        const lanes highest = F::most(lanes{}, F::most(F::dot(u, m), F::dot(v, m)));
        const lanes size = F::most(F::largest(F::sum_sizes(w0), F::sum_sizes(w1), F::sum_sizes(w2)),
                                   F::most(F::sum_sizes(u), F::sum_sizes(v)));
        const lanes sum = F::sum_sizes(m), length = sum > 0x1p-50f ? F::root(F::dot(m, m)) : sum;
        const lanes wide = (gap * length + (error + 0x1p-20f * size) * sum) * (1.0f + 0x1p-18f);
        return (lowest - highest > wide) & (sum > 0x1p-100f) & (size < 0x1p60f);
    }
    CUDA_CALLABLE lanes side_of_plane(const Point& a, const Point& b, const Point& c, const Point& d,
                                      lanes& bound) const {
        const Point u = F::minus(a, d), v = F::minus(b, d), w = F::minus(c, d);
        bound = bound_error(F::sum_sizes(u), F::sum_sizes(v), F::sum_sizes(w));
        return F::dot(u, F::cross(v, w));
    }
};

// One lane: negative where three heights have the same sign, not 0, beyond a bound.
inline CUDA_CALLABLE int one_sided(const PlaneFilter::Heights& heights, const PlaneFilter::lanes& wide) {
    const float x[3] = {Float32::first(heights.value[0]), Float32::first(heights.value[1]),
                        Float32::first(heights.value[2])};
    const float bound = Float32::first(wide);
#if defined(__CUDA_ARCH__)
    // x < y is the sign bit of x - y, also where they are nearly the same, infinite or no numbers.
    const int p0 = __float_as_int(__fsub_rn(bound, x[0])), n0 = __float_as_int(__fadd_rn(x[0], bound));
    const int p1 = __float_as_int(__fsub_rn(bound, x[1])), n1 = __float_as_int(__fadd_rn(x[1], bound));
    const int p2 = __float_as_int(__fsub_rn(bound, x[2])), n2 = __float_as_int(__fadd_rn(x[2], bound));
    return (p0 & p1 & p2) | (n0 & n1 & n2);
#else
    const bool over = (x[0] > bound) & (x[1] > bound) & (x[2] > bound);
    const bool under = (x[0] < -bound) & (x[1] < -bound) & (x[2] < -bound);
    return -(over | under);
#endif
}

// Signs with those of three more numbers after them.
inline CUDA_CALLABLE int add_signs(int signs, const PlaneFilter::Heights& heights) {
    const float bound = Float32::first(heights.bound);
    for (int k = 0; k < 3; ++k) {
        const float x = Float32::first(heights.value[k]);
#if defined(__CUDA_ARCH__)
        // Each takes the sign bit of a number from the right, as in `one_sided`.
        signs = __funnelshift_l(__float_as_int(__fsub_rn(bound, x)), signs, 1);
        signs = __funnelshift_l(__float_as_int(__fadd_rn(x, bound)), signs, 1);
#else
        signs = signs * 4 + (x > bound) * 2 + (x < -bound);
#endif
    }
    return signs;
}

inline CUDA_CALLABLE wp::int32 plane_signs(wp::float32 error, wp::float32 unit, wp::mat33 a, wp::mat33 b) {
    Float32::Point of[3], other[3];
    spread_corners(a, of);
    spread_corners(b, other);
    PlaneFilter::Heights of_a, of_b;
    PlaneFilter{error, unit}.compare_planes(of, other, of_a, of_b);
    const int signs = add_signs(add_signs(0, of_a), of_b);
    return (one_sided(of_a, of_a.bound) | one_sided(of_b, of_b.bound)) < 0 ? -1 : signs;
}

inline CUDA_CALLABLE wp::int32 gap_signs(wp::float32 error, wp::float32 unit, wp::float32 gap, wp::mat33 a,
                                         wp::mat33 b) {
    Float32::Point of[3], other[3];
    spread_corners(a, of);
    spread_corners(b, other);
    const PlaneFilter filter = {error, unit};
    PlaneFilter::Heights of_a, of_b;
    filter.compare_planes(of, other, of_a, of_b);
    const int signs = add_signs(add_signs(0, of_a), of_b);
    const int separated =
        one_sided(of_a, filter.widen(of_a.bound, gap, other)) | one_sided(of_b, filter.widen(of_b.bound, gap, of));
    const bool beyond =
        Float32::first(filter.are_beyond_edge(of, other, gap)) | Float32::first(filter.are_beyond_edge(other, of, gap));
    return separated < 0 || beyond ? -1 : signs;
}

// 1, -1, or UNCERTAIN; a bound of 0 makes 0 a sure sign.
inline CUDA_CALLABLE int filtered_sign(const PlaneFilter::lanes& value, const PlaneFilter::lanes& error) {
    const float x = Float32::first(value), bound = Float32::first(error);
    const int open = bound == 0.0f ? 0 : UNCERTAIN;
    return x > bound ? 1 : x < -bound ? -1 : open;
}

inline CUDA_CALLABLE wp::int32 side_of_plane(wp::float32 error, wp::float32 unit, wp::mat33 plane, wp::vec3 d) {
    Float32::Point p[3];
    spread_corners(plane, p);
    Float32::lanes bound, zero = {};
    const Float32::Point at = {zero + d[0], zero + d[1], zero + d[2]};
    return filtered_sign(PlaneFilter{error, unit}.side_of_plane(p[0], p[1], p[2], at, bound), bound);
}

inline CUDA_CALLABLE wp::int32 intersect_straddling(wp::float32 error, wp::float32 unit, wp::mat33 a, wp::mat33 b) {
    Float32::Point p[3], q[3];
    spread_corners(a, p);
    spread_corners(b, q);
    const PlaneFilter filter = {error, unit};
    Float32::lanes first_bound, second_bound;
    const int first = filtered_sign(filter.side_of_plane(p[0], p[1], q[0], q[1], first_bound), first_bound);
    const int second = filtered_sign(filter.side_of_plane(p[0], p[2], q[2], q[0], second_bound), second_bound);
    return first == 1 || second == 1 ? 0 : first == UNCERTAIN || second == UNCERTAIN ? UNCERTAIN : 1;
}
