// Numbers, points and determinants in float64: of one thread, or in lanes of the CPU (`Float64`). No rounding differs.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

struct Number64 {
    typedef double lanes;
    typedef bool bits;
    typedef float floats;
    typedef bool float_bits;
    typedef int integers;
    static CUDA_CALLABLE double absolute(double v) { return fabs(v); }
    static CUDA_CALLABLE double fuse(double a, double b, double c) { return fma(a, b, c); }
    static CUDA_CALLABLE double root(double v) { return sqrt(v); }
    static CUDA_CALLABLE bool negate(bool flag) { return !flag; }
    static CUDA_CALLABLE bool is_all(bool flag) { return flag; }
    static CUDA_CALLABLE bool any(bool flag) { return flag; }
    static CUDA_CALLABLE float narrow(double v) { return (float)v; }
    static CUDA_CALLABLE bool narrow_bits(bool flag) { return flag; }
#if defined(__CUDA_ARCH__)
    // Exponents that leave room for remainders.
    static CUDA_CALLABLE bool is_usual(double x) { return ((__double2hiint(x) >> 20) & 2047) - 523u < 1000u; }
    template <class Point>
    static __noinline__ CUDA_CALLABLE Point divide_plainly(const Point& v, double s) {
        return Point{v.x / s, v.y / s, v.z / s};
    }
    static CUDA_CALLABLE double multiply(double v, double y, double s) {
        const double q = __dmul_rn(v, y);
        return v == 0.0 ? q : __fma_rn(__fma_rn(-s, q, v), y, q);
    }
    // Divides by the one reciprocal where it is rounded correctly, so that this rounds the same. Source: Markstein
    // 1990, Computation of elementary functions on the IBM RISC System/6000 processor, theorem 3.
    template <class Point>
    static CUDA_CALLABLE Point divide(const Point& v, double s) {
        if (!(is_usual(s) & (__double2loint(s) != -1) & ((v.x == 0.0) | is_usual(v.x)) &
              ((v.y == 0.0) | is_usual(v.y)) & ((v.z == 0.0) | is_usual(v.z))))
            return divide_plainly(v, s);
        // The steps of a division, the first five once for three: y ends as 1 / s, rounded.
        double y;
        asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(s));
        double e = __fma_rn(-s, y, 1.0);
        e = __fma_rn(e, e, e);
        y = __fma_rn(y, e, y);
        e = __fma_rn(-s, y, 1.0);
        y = __fma_rn(y, e, y);
        return Point{multiply(v.x, y, s), multiply(v.y, y, s), multiply(v.z, y, s)};
    }
#else
    template <class Point>
    static Point divide(const Point& v, double s) {
        return Point{v.x / s, v.y / s, v.z / s};
    }
#endif
};

template <class Number>
struct Points64 : Number {
    typedef typename Number::lanes lanes;
    typedef typename Number::bits bits;
    using Number::absolute, Number::divide, Number::fuse, Number::negate;
    struct Point {
        lanes x, y, z;
    };
    struct Sign {
        lanes value, size;
    };

    static CUDA_CALLABLE Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static CUDA_CALLABLE Point sizes(const Point& a) { return Point{absolute(a.x), absolute(a.y), absolute(a.z)}; }
    static CUDA_CALLABLE lanes sum_sizes(const Point& v) { return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }
    static CUDA_CALLABLE Point choose(const bits& which, const Point& a, const Point& b) {
        return Point{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
    }
    static CUDA_CALLABLE lanes lesser(const lanes& a, const lanes& b) { return b < a ? b : a; }
    static CUDA_CALLABLE lanes greater(const lanes& a, const lanes& b) { return a < b ? b : a; }
    static CUDA_CALLABLE Point negate(const Point& v) { return Point{-v.x, -v.y, -v.z}; }
    static CUDA_CALLABLE lanes dot(const Point& a, const Point& b) { return (a.x * b.x + a.y * b.y) + a.z * b.z; }
    static CUDA_CALLABLE Point cross(const Point& a, const Point& b) {
        return Point{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    }
    // By columns, as Warp multiplies; and by the transpose.
    static CUDA_CALLABLE Point turn(const double (&m)[3][3], const Point& v) {
        return Point{(m[0][0] * v.x + m[0][1] * v.y) + m[0][2] * v.z, (m[1][0] * v.x + m[1][1] * v.y) + m[1][2] * v.z,
                     (m[2][0] * v.x + m[2][1] * v.y) + m[2][2] * v.z};
    }
    static CUDA_CALLABLE Point turn_back(const double (&m)[3][3], const Point& v) {
        return Point{(m[0][0] * v.x + m[1][0] * v.y) + m[2][0] * v.z, (m[0][1] * v.x + m[1][1] * v.y) + m[2][1] * v.z,
                     (m[0][2] * v.x + m[1][2] * v.y) + m[2][2] * v.z};
    }
    // As `pose_point`.
    static CUDA_CALLABLE Point pose(const double (&m)[3][3], const wp::vec3d& t, const Point& p) {
        const Point v = turn(m, p);
        const lanes x = v.x + t[0], y = v.y + t[1], z = v.z + t[2], zero = {};
        return Point{absolute(x) < COORDINATE_MIN ? zero : x, absolute(y) < COORDINATE_MIN ? zero : y,
                     absolute(z) < COORDINATE_MIN ? zero : z};
    }
    static CUDA_CALLABLE lanes largest(const Point& v) {
        const lanes x = absolute(v.x), y = absolute(v.y), z = absolute(v.z), m = x >= y ? x : y;
        return m >= z ? m : z;
    }
    // The length of a vector whose squares may underflow or overflow.
    static CUDA_CALLABLE lanes measure_length(const Point& v) {
        const lanes m = largest(v);
        if (Number::is_all(m == 0.0))
            return m;
        const Point u = divide(v, m);
        return m == 0.0 ? m : m * Number::root(dot(u, u));
    }
    // The zero vector stays as it is.
    static CUDA_CALLABLE Point unit_vector(const Point& v) {
        const lanes m = largest(v);
        if (Number::is_all(m == 0.0))
            return v;
        const Point u = divide(v, m);
        return choose(m == 0.0, v, divide(u, Number::root(dot(u, u))));
    }
    // The point of edge pq where a linear function of these values, of opposite signs or one 0, vanishes.
    static CUDA_CALLABLE Point cross_edge(const Point& p, const Point& q, const lanes& value_p, const lanes& value_q) {
        const lanes part = value_p / (value_p - value_q);
        const Point way = minus(q, p);
        return Point{p.x + way.x * part, p.y + way.y * part, p.z + way.z * part};
    }
    // det(u, v, w) of three differences, each product rounded, and the sum of magnitudes.
    static CUDA_CALLABLE Sign volume(const Point& u, const Point& v, const Point& w) {
        const lanes v1w2 = v.y * w.z, v2w1 = v.z * w.y, w1u2 = w.y * u.z, w2u1 = w.z * u.y;
        const lanes u1v2 = u.y * v.z, u2v1 = u.z * v.y;
        lanes size = absolute(u.x) * (absolute(v1w2) + absolute(v2w1));
        size = size + absolute(v.x) * (absolute(w1u2) + absolute(w2u1));
        size = size + absolute(w.x) * (absolute(u1v2) + absolute(u2v1));
        return Sign{(u.x * (v1w2 - v2w1) + v.x * (w1u2 - w2u1)) + w.x * (u1v2 - u2v1), size};
    }
    // det(a - c, b - c) of points in a plane, and the sum of magnitudes.
    static CUDA_CALLABLE Sign area(const lanes& ax, const lanes& ay, const lanes& bx, const lanes& by, const lanes& cx,
                                   const lanes& cy) {
        const lanes left = (ax - cx) * (by - cy), right = (ay - cy) * (bx - cx);
        return Sign{left - right, absolute(left) + absolute(right)};
    }
    // det(u, v, w) of three differences, of which magnitudes are given, and the sum of magnitudes.
    static CUDA_CALLABLE Sign determinant(const Point& u, const Point& v, const Point& w, const Point& u_size,
                                          const Point& v_size, const Point& w_size) {
        const lanes p = v.z * w.y, q = w.z * u.y, s = u.z * v.y;
        const lanes x = fuse(v.y, w.z, -p), x_size = fuse(v_size.y, w_size.z, absolute(p));
        const lanes y = fuse(w.y, u.z, -q), y_size = fuse(w_size.y, u_size.z, absolute(q));
        const lanes z = fuse(u.y, v.z, -s), z_size = fuse(u_size.y, v_size.z, absolute(s));
        return Sign{fuse(w.x, z, fuse(v.x, y, u.x * x)),
                    fuse(w_size.x, z_size, fuse(v_size.x, y_size, u_size.x * x_size))};
    }
    static CUDA_CALLABLE Sign determinant(const Point& u, const Point& v, const Point& w) {
        return determinant(u, v, w, sizes(u), sizes(v), sizes(w));
    }
    // The same of ends of edges, from differences of ends. Rows may be taken from one another: det(a - d, b - c, c - d)
    // and det(a - c, b - d, c - d) are the same number. Ends of edges that are laid on one another nearly coincide, so
    // one of the two has rows that are nearly nothing, and an error as small.
    static CUDA_CALLABLE Sign orient_edges(const Point& ac, const Point& ad, const Point& bc, const Point& bd,
                                           const Point& cd) {
        const bits across = sum_sizes(ad) * sum_sizes(bc) < sum_sizes(ac) * sum_sizes(bd);
        return determinant(choose(across, ad, ac), choose(across, bc, bd), cd);
    }
};

typedef Points64<Number64> One64;

inline CUDA_CALLABLE One64::Point point_of(const wp::vec3d& v) { return {v[0], v[1], v[2]}; }

inline CUDA_CALLABLE wp::vec3d vector_of(const One64::Point& p) { return wp::vec3d(p.x, p.y, p.z); }

inline CUDA_CALLABLE wp::vec2d pair_of(const One64::Sign& sign) { return wp::vec2d(sign.value, sign.size); }

inline CUDA_CALLABLE wp::vec3d divide_vector(wp::vec3d v, wp::float64 s) {
    return vector_of(One64::divide(point_of(v), s));
}

inline CUDA_CALLABLE wp::float64 measure_length(wp::vec3d v) { return One64::measure_length(point_of(v)); }

inline CUDA_CALLABLE wp::vec3d unit_vector(wp::vec3d v) { return vector_of(One64::unit_vector(point_of(v))); }

inline CUDA_CALLABLE wp::vec3d cross_edge(wp::vec3d p, wp::vec3d q, wp::float64 value_p, wp::float64 value_q) {
    return vector_of(One64::cross_edge(point_of(p), point_of(q), value_p, value_q));
}

inline CUDA_CALLABLE wp::vec2d round_volume(wp::vec3d u, wp::vec3d v, wp::vec3d w) {
    return pair_of(One64::volume(point_of(u), point_of(v), point_of(w)));
}

inline CUDA_CALLABLE wp::vec2d round_area(wp::vec2d a, wp::vec2d b, wp::vec2d c) {
    return pair_of(One64::area(a[0], a[1], b[0], b[1], c[0], c[1]));
}

inline CUDA_CALLABLE wp::vec2d rows_determinant(wp::vec3d u, wp::vec3d v, wp::vec3d w) {
    return pair_of(One64::determinant(point_of(u), point_of(v), point_of(w)));
}

inline CUDA_CALLABLE wp::vec2d edges_determinant(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d d) {
    return pair_of(
        One64::orient_edges(point_of(a - c), point_of(a - d), point_of(b - c), point_of(b - d), point_of(c - d)));
}
