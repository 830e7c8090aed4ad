// Determinants in integers: rounded once, as sums of products made word by word, so that no array holds them; and signs
// of those known to be small, in 128 bits that wrap.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "exact/double_word.cuh"
#include "exact/wide_integer.h"
#include "exact/word_sum.h"

inline CUDA_CALLABLE wp::float64 exact_volume(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d d) {
    typedef WideInteger Wide;
    // High and low word of each difference: six products of three, each of eight combinations.
    double part[3][3][2];
    int lowest = 0, highest = 0;
    for (int i = 0; i < 3; ++i) {
        int low = 1 << 20, high = 0;
        for (int j = 0; j < 3; ++j) {
            const double x = i == 0 ? a[j] : i == 1 ? b[j] : c[j];
            const double sum = x - d[j], taken = sum - x;
            part[i][j][0] = sum;
            part[i][j][1] = (x - (sum - taken)) - (d[j] + taken);
            for (int k = 0; k < 2; ++k) {
                const int exponent = Wide::exponent_of(part[i][j][k]);
                low = Wide::lower(low, Wide::lowest_bit(part[i][j][k]));
                high = exponent > high ? exponent : high;
            }
        }
        if (low == 1 << 20)
            return 0.0;  // a row of zeros
        lowest += low;
        highest += high + 1;
    }
    // Products are below 2^(highest + 159), and there are 48.
    const int length = highest + 159 + 6 - lowest;
    WordSum sum;
    for (int start = 0; start < length; start += 64) {
        for (int term = 0; term < 48; ++term) {
            const int i = term >> 4, odd = (term >> 3) & 1, j = (i + 1 + odd) % 3, k = (i + 2 - odd) % 3;
            const double x = part[0][i][term & 1], y = part[1][j][(term >> 1) & 1], z = part[2][k][(term >> 2) & 1];
            const bool negative = ((x < 0.0) != (y < 0.0)) != ((z < 0.0) != (odd != 0));
            sum.add(Wide::product_word(x, y, z, lowest + start), negative);
        }
        sum.end_word(start);
    }
    return sum.round(lowest - 3 * 1075);
}

inline CUDA_CALLABLE wp::int32 integer_orient3d(wp::vec3d a, wp::vec3d b, wp::vec3d c, wp::vec3d d, wp::float64 bound) {
    typedef WideInteger Wide;
    const int top = Wide::exponent_of(bound);
    if (top == 2047)
        return UNCERTAIN;
    const double row[3][3] = {{a[0], a[1], a[2]}, {b[0], b[1], b[2]}, {c[0], c[1], c[2]}};
    const double last[3] = {d[0], d[1], d[2]};
    Wide x[3][3];
    int units = 0;
#pragma unroll  // no array then
    for (int i = 0; i < 3; ++i) {
        int unit = 1 << 20;
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            if (Wide::exponent_of(row[i][j]) == 2047 || Wide::exponent_of(last[j]) == 2047)
                return UNCERTAIN;
            unit = Wide::lower(unit, Wide::lower(Wide::lowest_bit(row[i][j]), Wide::lowest_bit(last[j])));
        }
        if (unit == 1 << 20)
            return 0;  // a row of zeros
#pragma unroll
        for (int j = 0; j < 3; ++j)
            x[i][j] = Wide::add(Wide::count_units(row[i][j], unit), Wide::negate(Wide::count_units(last[j], unit)));
        units += unit;
    }
    // bound < 2^(top - 1022), and the determinant is within 4 times that: within 2^126 times 2^(units - 3 * 1075)?
    if ((top > 0 ? top : 1) - 1020 > 126 + units - 3 * 1075)
        return UNCERTAIN;
    const Wide first = Wide::multiply(x[0][0], Wide::minor(x[1][1], x[2][2], x[1][2], x[2][1]));
    const Wide second = Wide::multiply(x[0][1], Wide::minor(x[1][2], x[2][0], x[1][0], x[2][2]));
    const Wide third = Wide::multiply(x[0][2], Wide::minor(x[1][0], x[2][1], x[1][1], x[2][0]));
    return Wide::sign_of(Wide::add(Wide::add(first, second), third));
}

inline CUDA_CALLABLE wp::int32 integer_orient2d(wp::vec2d a, wp::vec2d b, wp::vec2d c, wp::float64 bound) {
    typedef WideInteger Wide;
    const int top = Wide::exponent_of(bound);
    if (top == 2047)
        return UNCERTAIN;
    const double row[2][2] = {{a[0], a[1]}, {b[0], b[1]}};
    const double last[2] = {c[0], c[1]};
    Wide x[2][2];
    int units = 0;
    for (int i = 0; i < 2; ++i) {
        int unit = 1 << 20;
        for (int j = 0; j < 2; ++j) {
            if (Wide::exponent_of(row[i][j]) == 2047 || Wide::exponent_of(last[j]) == 2047)
                return UNCERTAIN;
            unit = Wide::lower(unit, Wide::lower(Wide::lowest_bit(row[i][j]), Wide::lowest_bit(last[j])));
        }
        if (unit == 1 << 20)
            return 0;  // a row of zeros
        for (int j = 0; j < 2; ++j)
            x[i][j] = Wide::add(Wide::count_units(row[i][j], unit), Wide::negate(Wide::count_units(last[j], unit)));
        units += unit;
    }
    if ((top > 0 ? top : 1) - 1020 > 126 + units - 2 * 1075)
        return UNCERTAIN;
    return Wide::sign_of(Wide::minor(x[0][0], x[1][1], x[0][1], x[1][0]));
}
