// Sums of two float64 numbers, the second at most half a unit in the last place of the first, and points of them.
// Source: Joldes, Muller and Popescu 2017, Tight and rigorous error bounds for basic building blocks of double-word
// arithmetic, algorithms 6 and 11: a sum errs by at most 3 u^2 + 13 u^3 of itself, a product by 5 u^2, u = 2^-53.
#pragma once
#include "builtin.h"

// Calls on CUDA: inlined, these made kernels four times as long, for what few threads need.
#if defined(__CUDA_ARCH__)
#define CALLED __noinline__ CUDA_CALLABLE
#else
#define CALLED CUDA_CALLABLE
#endif

struct DoubleWord {
    double high, low;

    static CUDA_CALLABLE DoubleWord add_exactly(double a, double b) {
        const double x = a + b, virtual_b = x - a, virtual_a = x - virtual_b;
        return {x, (a - virtual_a) + (b - virtual_b)};
    }
    static CUDA_CALLABLE double larger(double a, double b) { return a < b ? b : a; }
    // |a| >= |b|
    static CUDA_CALLABLE DoubleWord add_fast(double a, double b) {
        const double x = a + b;
        return {x, b - (x - a)};
    }
    CUDA_CALLABLE DoubleWord operator-() const { return {-high, -low}; }
    CUDA_CALLABLE DoubleWord operator+(const DoubleWord& b) const {
        const DoubleWord highs = add_exactly(high, b.high), lows = add_exactly(low, b.low);
        const DoubleWord x = add_fast(highs.high, highs.low + lows.high);
        return add_fast(x.high, lows.low + x.low);
    }
    CUDA_CALLABLE DoubleWord operator-(const DoubleWord& b) const { return *this + -b; }
    CUDA_CALLABLE DoubleWord operator*(const DoubleWord& b) const {
        const double x = high * b.high;
        return add_fast(x, fma(high, b.high, -x) + fma(low, b.high, high * b.low));
    }
    CUDA_CALLABLE bool is_below(double b) const { return high < b || (high == b && low < 0.0); }
};

struct Point {
    DoubleWord x[3];

    CALLED Point operator+(const Point& b) const { return {{x[0] + b.x[0], x[1] + b.x[1], x[2] + b.x[2]}}; }
    CALLED Point operator-(const Point& b) const { return {{x[0] - b.x[0], x[1] - b.x[1], x[2] - b.x[2]}}; }
    CALLED Point operator*(const DoubleWord& b) const { return {{x[0] * b, x[1] * b, x[2] * b}}; }
    CALLED DoubleWord dot(const Point& b) const { return x[0] * b.x[0] + x[1] * b.x[1] + x[2] * b.x[2]; }
    CALLED Point cross(const Point& b) const {
        return {{x[1] * b.x[2] - x[2] * b.x[1], x[2] * b.x[0] - x[0] * b.x[2], x[0] * b.x[1] - x[1] * b.x[0]}};
    }
    CUDA_CALLABLE double largest() const {
        return DoubleWord::larger(DoubleWord::larger(fabs(x[0].high), fabs(x[1].high)), fabs(x[2].high));
    }
    // Return the float64 numbers next to it.
    CUDA_CALLABLE Point rounded() const { return {{{x[0].high, 0.0}, {x[1].high, 0.0}, {x[2].high, 0.0}}}; }
};
