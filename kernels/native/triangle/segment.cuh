// The segment that two faces in general position share, and normals: of one pair in a thread, of 8 on the CPU.
// What is sure has the bits of `segment.intersect_faces`, which decides the rest: a determinant whose float64 value may
// err too much there is the sum of an expansion, off the float64 number next to it by nothing but a tie that double
// words exclude.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "exact/double_word.cuh"

template <class Number>
struct SharedSegment : Points64<Number> {
    typedef Points64<Number> F;
    typedef DoubleWords<Number> Words;
    typedef typename F::lanes lanes;
    typedef typename F::bits bits;
    typedef typename F::Point Point;
    typedef typename F::Sign Sign;

    // A triangle from the corner on that is alone on its side of the other's plane, in either direction.
    struct Rotated {
        Point p, q, r;
        lanes of_p, of_q, of_r;
        bits below;
    };
    static CUDA_CALLABLE lanes pick(const bits& which, const lanes& a, const lanes& b) { return which ? a : b; }
    static CUDA_CALLABLE bits errs(double bound, const Sign& x) {
        return bound * x.size > RELATIVE_ERROR * F::absolute(x.value);
    }
    // Puts the number next to each of so many words in the place of values that are open, where a bound leaves one.
    static CUDA_CALLABLE void round(const Words& words, const lanes& bound, lanes& value, bits& open) {
        value = open ? words.high : value;
        open &= Number::negate(words.rounds_to_high(bound));
    }
    // Whether the ends on edges p1 e1 and p2 e2 come one after the other along the line of both planes, or before it.
    static CUDA_CALLABLE bits order_ends(const Point& p1, const Point& e1, const Point& p2, const Point& e2,
                                         bits& before, bits& open) {
        const Sign sign = F::determinant(F::minus(p1, e2), F::minus(e1, e2), F::minus(p2, e2));
        const lanes bound = BOUND_3D * sign.size;
        const bits after = sign.value > bound;
        before = sign.value < -bound;
        open |= Number::negate(after | before) & (bound != 0.0);
        return after;
    }
    // As `rotate_corners` where no corner touches. Adds those of which all corners are on one side to a mask.
    static CUDA_CALLABLE Rotated rotate(const Point (&c)[3], const lanes (&x)[3], bits& open) {
        const bits up0 = x[0] > 0.0, up1 = x[1] > 0.0, up2 = x[2] > 0.0, odd = up0 ^ up1, other = up1 ^ up2;
        const bits first = odd & Number::negate(other), second = odd & other;
        open |= (x[0] == 0.0) | (x[1] == 0.0) | (x[2] == 0.0) | Number::negate(odd | other);
        Rotated t;
        t.p = F::choose(first, c[0], F::choose(second, c[1], c[2]));
        t.q = F::choose(first, c[1], F::choose(second, c[2], c[0]));
        t.r = F::choose(first, c[2], F::choose(second, c[0], c[1]));
        t.of_p = pick(first, x[0], pick(second, x[1], x[2]));
        t.of_q = pick(first, x[1], pick(second, x[2], x[0]));
        t.of_r = pick(first, x[2], pick(second, x[0], x[1]));
        t.below = Number::negate(t.of_p > 0.0);
        return t;
    }
    static CUDA_CALLABLE void turn_round(const bits& which, Rotated& t) {
        const Point q = t.q;
        const lanes of_q = t.of_q;
        t.q = F::choose(which, t.r, q);
        t.r = F::choose(which, q, t.r);
        t.of_q = pick(which, t.of_r, of_q);
        t.of_r = pick(which, of_q, t.of_r);
    }
    // The ends, from corners and their volumes with the other triangle, and whether they run the other way round.
    // Source: as `segment.cross_planes`.
    static CUDA_CALLABLE bits find_ends(bool proven, const Point (&a)[3], const Point (&b)[3], const lanes (&u)[3],
                                        const lanes (&v)[3], Point& start, Point& end, bits& open) {
        Rotated s = rotate(a, u, open), t = rotate(b, v, open);
        turn_round(t.below, s);
        turn_round(s.below, t);
        // Of X(q), X(r) on A's edges against Y(q), Y(r) on B's; that the other two are in order is why faces meet.
        bits before;
        const bits qr = order_ends(s.p, s.q, t.p, t.r, before, open);
        const bits rq = order_ends(s.p, s.r, t.p, t.q, before, open);
        if (!proven) {
            open |= order_ends(s.p, s.q, t.p, t.q, before, open);
            order_ends(s.p, s.r, t.p, t.r, before, open);
            open |= before;
        }
        start = F::cross_edge(F::choose(qr, s.p, t.p), F::choose(qr, s.q, t.r), pick(qr, s.of_p, t.of_p),
                              pick(qr, s.of_q, t.of_r));
        end = F::cross_edge(F::choose(rq, t.p, s.p), F::choose(rq, t.q, s.r), pick(rq, t.of_p, s.of_p),
                            pick(rq, t.of_q, s.of_r));
        return s.below ^ t.below;
    }
};

// Of one pair: each thread takes its own next of the determinants that err too much, so that none waits for others.
struct ThreadSegment : SharedSegment<Number64> {
    typedef DoubleWord W;
    static CUDA_CALLABLE double rounded(const W& words, double bound, bool& open) {
        double value = 0.0;
        bool left = true;
        round(words, bound, value, left);
        open |= left;
        return value;
    }
    // Calls: long, and rare.
    static CALLED double extend_volume(const Point& a, const Point& b, const Point& c, const Point& d, bool& open) {
        const double size = F::volume(F::minus(a, d), F::minus(b, d), F::minus(c, d)).size;
        return rounded(W::orient3d(a, b, c, d), BOUND_DOUBLE * size, open);
    }
    static CALLED double extend_area(double ax, double ay, double bx, double by, double cx, double cy, bool& open) {
        const double size = F::area(ax, ay, bx, by, cx, cy).size;
        return rounded(W::orient2d(ax, ay, bx, by, cx, cy), BOUND_DOUBLE * size, open);
    }
    static CUDA_CALLABLE int lowest(int bits) {
#if defined(__CUDA_ARCH__)
        return __ffs(bits) - 1;
#else
        return __builtin_ctz(bits);
#endif
    }
    static CUDA_CALLABLE void find_volumes(const Point (&a)[3], const Point (&b)[3], double (&x)[6], bool& open) {
        int pending = 0;
#pragma unroll
        for (int k = 0; k < 6; ++k) {
            const Point(&f)[3] = k < 3 ? b : a;
            const Point& d = k < 3 ? a[k] : b[k - 3];
            const Sign sign = F::volume(F::minus(f[0], d), F::minus(f[1], d), F::minus(f[2], d));
            x[k] = sign.value;
            pending |= errs(BOUND_3D, sign) << k;
        }
        for (; pending != 0; pending &= pending - 1) {
            const int k = lowest(pending), i = k % 3;
            const bool of_a = k < 3;
            const Point d = F::choose(i == 0, F::choose(of_a, a[0], b[0]),
                                      F::choose(i == 1, F::choose(of_a, a[1], b[1]), F::choose(of_a, a[2], b[2])));
            const double value = extend_volume(F::choose(of_a, b[0], a[0]), F::choose(of_a, b[1], a[1]),
                                               F::choose(of_a, b[2], a[2]), d, open);
#pragma unroll
            for (int j = 0; j < 6; ++j)
                x[j] = j == k ? value : x[j];
        }
    }
    static CUDA_CALLABLE Point find_normal(const Point& a, const Point& b, const Point& c, bool& open) {
        const Sign x = F::area(a.y, a.z, b.y, b.z, c.y, c.z), y = F::area(a.z, a.x, b.z, b.x, c.z, c.x);
        const Sign z = F::area(a.x, a.y, b.x, b.y, c.x, c.y);
        Point n = {x.value, y.value, z.value};
        int pending = errs(BOUND_2D, x) | errs(BOUND_2D, y) << 1 | errs(BOUND_2D, z) << 2;
        for (; pending != 0; pending &= pending - 1) {
            const int k = lowest(pending);
            auto drop = [&](const Point& p, double& first, double& second) {
                first = k == 0 ? p.y : k == 1 ? p.z : p.x;
                second = k == 0 ? p.z : k == 1 ? p.x : p.y;
            };
            double ax, ay, bx, by, cx, cy;
            drop(a, ax, ay);
            drop(b, bx, by);
            drop(c, cx, cy);
            const double value = extend_area(ax, ay, bx, by, cx, cy, open);
            n = {k == 0 ? value : n.x, k == 1 ? value : n.y, k == 2 ? value : n.z};
        }
        return F::unit_vector(n);
    }
};

inline CUDA_CALLABLE bool find_normal(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d& normal) {
    bool open = false;
    normal = vector_of(ThreadSegment::find_normal(point_of(a), point_of(b), point_of(c), open));
    return !open;
}

inline CUDA_CALLABLE bool find_segment(bool proven, wp::mat33d a, wp::mat33d b, wp::vec3d& start, wp::vec3d& end) {
    typedef ThreadSegment S;
    const S::Point corners_a[3] = {point_of(a.get_row(0)), point_of(a.get_row(1)), point_of(a.get_row(2))};
    const S::Point corners_b[3] = {point_of(b.get_row(0)), point_of(b.get_row(1)), point_of(b.get_row(2))};
    double x[6];
    bool open = false;
    S::find_volumes(corners_a, corners_b, x, open);
    const double u[3] = {x[0], x[1], x[2]}, v[3] = {x[3], x[4], x[5]};
    S::Point first, last;
    const bool turned = S::find_ends(proven, corners_a, corners_b, u, v, first, last, open);
    start = vector_of(S::choose(turned, last, first));
    end = vector_of(S::choose(turned, first, last));
    return !open;
}
