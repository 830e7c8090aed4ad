// Sums of two float64 numbers, the second at most half a unit in the last place of the first.
// With u = 2^-53 a product errs by at most 5 u^2 of itself and a sum by 3 u^2 + 13 u^3; differences of float64 numbers
// are double words exactly. Source: Joldes, Muller and Popescu 2017, Tight and rigorous error bounds for basic building
// blocks of double-word arithmetic, algorithms 11 and 6.
#pragma once
#include "builtin.h"
#include "base/points64.cuh"

// Calls on CUDA: inlined, these made kernels four times as long, for what few threads need.
#if defined(__CUDA_ARCH__)
#define CALLED __noinline__ CUDA_CALLABLE
#else
#define CALLED CUDA_CALLABLE
#endif

template <class Number>
struct DoubleWords {
    typedef typename Number::lanes lanes;
    typedef typename Number::bits bits;
    lanes high, low;

    static CUDA_CALLABLE DoubleWords add_exactly(const lanes& a, const lanes& b) {
        const lanes x = a + b, virtual_b = x - a, virtual_a = x - virtual_b;
        return {x, (a - virtual_a) + (b - virtual_b)};
    }
    static CUDA_CALLABLE lanes larger(const lanes& a, const lanes& b) { return a < b ? b : a; }
    // |a| >= |b|
    static CUDA_CALLABLE DoubleWords add_fast(const lanes& a, const lanes& b) {
        const lanes x = a + b;
        return {x, b - (x - a)};
    }
    CUDA_CALLABLE DoubleWords operator-() const { return {-high, -low}; }
    CUDA_CALLABLE DoubleWords operator+(const DoubleWords& b) const {
        const DoubleWords highs = add_exactly(high, b.high), lows = add_exactly(low, b.low);
        const DoubleWords x = add_fast(highs.high, highs.low + lows.high);
        return add_fast(x.high, lows.low + x.low);
    }
    CUDA_CALLABLE DoubleWords operator-(const DoubleWords& b) const { return *this + -b; }
    CUDA_CALLABLE DoubleWords operator*(const DoubleWords& b) const {
        const lanes x = high * b.high;
        return add_fast(x, Number::fuse(high, b.high, -x) + Number::fuse(low, b.high, high * b.low));
    }
    CUDA_CALLABLE bool is_below(double b) const { return high < b || (high == b && low < 0.0); }
    // Return whether `high` is the number next to all within a bound; twice the bound, for the rounding of these sums.
    CUDA_CALLABLE bits rounds_to_high(const lanes& bound) const {
        return (high + (low + 2.0 * bound) == high) & (high + (low - 2.0 * bound) == high);
    }
    // det(a - d, b - d, c - d) to about 2^-104 of its sum of magnitudes.
    template <class P>
    static CUDA_CALLABLE DoubleWords orient3d(const P& a, const P& b, const P& c, const P& d) {
        typedef DoubleWords W;
        const W u0 = add_exactly(a.x, -d.x), u1 = add_exactly(a.y, -d.y), u2 = add_exactly(a.z, -d.z);
        const W v0 = add_exactly(b.x, -d.x), v1 = add_exactly(b.y, -d.y), v2 = add_exactly(b.z, -d.z);
        const W w0 = add_exactly(c.x, -d.x), w1 = add_exactly(c.y, -d.y), w2 = add_exactly(c.z, -d.z);
        return (u0 * (v1 * w2 + -v2 * w1) + v0 * (w1 * u2 + -w2 * u1)) + w0 * (u1 * v2 + -u2 * v1);
    }
    // det(a - c, b - c), as well, of points in a plane.
    static CUDA_CALLABLE DoubleWords orient2d(const lanes& ax, const lanes& ay, const lanes& bx, const lanes& by,
                                              const lanes& cx, const lanes& cy) {
        return add_exactly(ax, -cx) * add_exactly(by, -cy) + -add_exactly(ay, -cy) * add_exactly(bx, -cx);
    }
};

typedef DoubleWords<Number64> DoubleWord;

inline CUDA_CALLABLE wp::vec2d add_double(wp::vec2d a, wp::vec2d b) {
    const DoubleWord sum = DoubleWord{a[0], a[1]} + DoubleWord{b[0], b[1]};
    return wp::vec2d(sum.high, sum.low);
}

inline CUDA_CALLABLE wp::vec2d double_orient3d(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d d) {
    const DoubleWord value = DoubleWord::orient3d(point_of(a), point_of(b), point_of(c), point_of(d));
    return wp::vec2d(value.high, value.low);
}

inline CUDA_CALLABLE wp::vec2d double_orient2d(wp::vec2d a, wp::vec2d b, wp::vec2d c) {
    const DoubleWord value = DoubleWord::orient2d(a[0], a[1], b[0], b[1], c[0], c[1]);
    return wp::vec2d(value.high, value.low);
}
