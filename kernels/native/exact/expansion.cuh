// Determinants as expansions, rounded component by component.
#pragma once
#include "builtin.h"
#include "exact/expansion_sum.h"
#include "base/sizes.h"

CALLED wp::float64 expand_volume(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d d) {
#if defined(__CUDA_ARCH__)
    // Of odd length, so that lanes at the same component take different banks.
    __shared__ double rows[EXPANSION_LANES][EXPANSION_LENGTH + 1];
    ExpansionSum sum = {rows[threadIdx.x % EXPANSION_LANES], 0};
#else
    double row[EXPANSION_LENGTH];
    ExpansionSum sum = {row, 0};
#endif
    DoubleWord u[3], v[3], w[3];
    for (int i = 0; i < 3; ++i) {
        u[i] = DoubleWord::add_exactly(a[i], -d[i]);
        v[i] = DoubleWord::add_exactly(b[i], -d[i]);
        w[i] = DoubleWord::add_exactly(c[i], -d[i]);
    }
    // Bits of a term: the words, then whether the permutation is odd, then the axis of u.
    for (int term = 0; term < 48; ++term) {
        const int i = term >> 4, odd = (term >> 3) & 1, j = (i + 1 + odd) % 3, k = (i + 2 - odd) % 3;
        const double x = (term & 1) != 0 ? u[i].low : u[i].high;
        sum.add_product(odd != 0 ? -x : x, (term & 2) != 0 ? v[j].low : v[j].high,
                        (term & 4) != 0 ? w[k].low : w[k].high);
    }
    return sum.value();
}

CALLED wp::float64 expand_area(wp::vec2d a, wp::vec2d b, wp::vec2d c) {
    double row[16];  // products of two: eight of two words, and their zeros
    ExpansionSum sum = {row, 0};
    DoubleWord u[2], v[2];
    for (int i = 0; i < 2; ++i) {
        u[i] = DoubleWord::add_exactly(a[i], -c[i]);
        v[i] = DoubleWord::add_exactly(b[i], -c[i]);
    }
    for (int term = 0; term < 8; ++term) {
        const int i = term >> 2;
        const double x = (term & 1) != 0 ? u[i].low : u[i].high;
        sum.add_product(i != 0 ? -x : x, (term & 2) != 0 ? v[1 - i].low : v[1 - i].high, 1.0);
    }
    return sum.value();
}
