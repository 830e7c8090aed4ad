// Double words in 8 lanes, as `exact.double_word`, whose source and bounds are these.
#pragma once
#include "builtin.h"
#include "base/float64.h"

struct Double64 {
    typedef Float64 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    struct Words {
        lanes high, low;
    };

    static Words two_sum(const lanes& a, const lanes& b) {
        const lanes x = a + b, of_b = x - a, of_a = x - of_b;
        return Words{x, (a - of_a) + (b - of_b)};
    }
    static Words add_fast(const lanes& a, const lanes& b) {
        const lanes x = a + b;
        return Words{x, b - (x - a)};
    }
    static Words multiply(const Words& a, const Words& b) {
        const lanes high = a.high * b.high, low = F::fuse(a.high, b.high, -high);
        return add_fast(high, low + F::fuse(a.low, b.high, a.high * b.low));
    }
    static Words add(const Words& a, const Words& b) {
        const Words high = two_sum(a.high, b.high), low = two_sum(a.low, b.low);
        const Words part = add_fast(high.high, high.low + low.high);
        return add_fast(part.high, low.low + part.low);
    }
    // a b - c d
    static Words minor(const Words& a, const Words& b, const Words& c, const Words& d) {
        return add(multiply(a, b), multiply(Words{-c.high, -c.low}, d));
    }
    static Words orient3d(const Point& a, const Point& b, const Point& c, const Point& d) {
        const Words u0 = two_sum(a.x, -d.x), u1 = two_sum(a.y, -d.y), u2 = two_sum(a.z, -d.z);
        const Words v0 = two_sum(b.x, -d.x), v1 = two_sum(b.y, -d.y), v2 = two_sum(b.z, -d.z);
        const Words w0 = two_sum(c.x, -d.x), w1 = two_sum(c.y, -d.y), w2 = two_sum(c.z, -d.z);
        const Words x = multiply(u0, minor(v1, w2, v2, w1)), y = multiply(v0, minor(w1, u2, w2, u1));
        return add(add(x, y), multiply(w0, minor(u1, v2, u2, v1)));
    }
    static Words orient2d(const lanes& ax, const lanes& ay, const lanes& bx, const lanes& by, const lanes& cx,
                          const lanes& cy) {
        return minor(two_sum(ax, -cx), two_sum(by, -cy), two_sum(ay, -cy), two_sum(bx, -cx));
    }
    // Puts the number next to each of so many values in the place of those that are open, where a bound leaves one.
    static lanes round(const Words& value, const lanes& bound, const lanes& plain, bits& open) {
        const lanes above = value.high + (value.low + 2.0 * bound), below = value.high + (value.low - 2.0 * bound);
        const bits sure = (above == value.high) & (below == value.high);
        const lanes rounded = open ? value.high : plain;
        open &= ~sure;
        return rounded;
    }
};
