// Signs of determinants known to be small, in integers of 128 bits that wrap.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "exact/wide_integer.h"

inline CUDA_CALLABLE wp::int32 integer_orient3d(wp::vec_t<3, wp::float64> a, wp::vec_t<3, wp::float64> b,
                                                wp::vec_t<3, wp::float64> c, wp::vec_t<3, wp::float64> d,
                                                wp::float64 bound) {
#include "base/sizes.h"
#include "exact/wide_integer.h"
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

inline CUDA_CALLABLE wp::int32 integer_orient2d(wp::vec_t<2, wp::float64> a, wp::vec_t<2, wp::float64> b,
                                                wp::vec_t<2, wp::float64> c, wp::float64 bound) {
#include "base/sizes.h"
#include "exact/wide_integer.h"
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
