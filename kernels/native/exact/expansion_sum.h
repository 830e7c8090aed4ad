// A sum of float64 components that do not overlap, smallest first, none of them 0: the number, not an approximation.
// Source: Shewchuk 1997, Adaptive precision floating-point arithmetic and fast robust geometric predicates.
#pragma once
#include "builtin.h"
#include "exact/double_word.cuh"

struct ExpansionSum {
    double* component;
    int length;

    // Source: theorem 10.
    CUDA_CALLABLE void add(double b) {
        double carry = b;
        int kept = 0;
        for (int i = 0; i < length; ++i) {
            const DoubleWord sum = DoubleWord::add_exactly(carry, component[i]);
            carry = sum.high;
            if (sum.low != 0.0)
                component[kept++] = sum.low;
        }
        if (carry != 0.0)
            component[kept++] = carry;
        length = kept;
    }
    CUDA_CALLABLE void add_product(double a, double b, double c) {
        if (a == 0.0 || b == 0.0 || c == 0.0)
            return;
        const double high = a * b, low = fma(a, b, -high), low_high = low * c, high_high = high * c;
        const double parts[4] = {fma(low, c, -low_high), low_high, fma(high, c, -high_high), high_high};
        for (int i = 0; i < 4; ++i)
            add(parts[i]);
    }
    // A few roundings of relative size 2^-53.
    CUDA_CALLABLE double value() const {
        double sum = 0.0;
        for (int i = 0; i < length; ++i)
            sum += component[i];
        return sum;
    }
};
