"""Exact signs of determinants known to be small, in 128-bit integers that wrap: most often those that are 0.

A row of differences is whole multiples of a power of two, the lowest bit set in any number of it, so the determinant is
a whole multiple of the product G of its rows' powers. Computed modulo 2^128 it is right to the bit once it is known to
lie within 2^126 G. Double words leave a sign open only where it lies within 2^-98 P, P its sum of magnitudes, so that
is so wherever P < 2^223 G: unless coordinates of a row differ in magnitude by some 2^19.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

UNDETERMINED = 8  # `predicates.UNSURE`

# Decodes float64 numbers. A number is its digits times 2^(its exponent - 1075); 0 has no lowest bit.
DECODE = """
    typedef unsigned long long word;
    auto bits_of = [](double x) {
        word bits;
        memcpy(&bits, &x, 8);
        return bits;
    };
    auto exponent_of = [&](double x) { return (int)((bits_of(x) >> 52) & 2047); };
    auto digits_of = [&](double x) {
        const word low = bits_of(x) & ((1ull << 52) - 1);
        return exponent_of(x) > 0 ? low | (1ull << 52) : low;
    };
    auto lowest_bit = [&](double x) {
        const word digits = digits_of(x);
        const int exponent = exponent_of(x);
        if (digits == 0)
            return 1 << 20;
#if defined(__CUDA_ARCH__)
        return (exponent > 0 ? exponent : 1) + __ffsll((long long)digits) - 1;
#else
        return (exponent > 0 ? exponent : 1) + __builtin_ctzll(digits);
#endif
    };
    struct Wide { word high, low; };
    auto negate = [](const Wide& x) { return Wide{~x.high + (x.low == 0), 0 - x.low}; };
    auto add = [](const Wide& x, const Wide& y) {
        const word low = x.low + y.low;
        return Wide{x.high + y.high + (low < x.low), low};
    };
    auto multiply = [](const Wide& x, const Wide& y) {
#if defined(__CUDA_ARCH__)
        const word carry = __umul64hi(x.low, y.low);
#else
        const word carry = (word)(((unsigned __int128)x.low * y.low) >> 64);
#endif
        return Wide{carry + x.high * y.low + x.low * y.high, x.low * y.low};
    };
    auto minor = [&](const Wide& a, const Wide& b, const Wide& c, const Wide& d) {
        return add(multiply(a, b), negate(multiply(c, d)));
    };
    auto sign_of = [](const Wide& x) { return (long long)x.high < 0 ? -1 : (x.high | x.low) != 0; };
    // In units of 2^(unit - 1075), no larger than its lowest bit, modulo 2^128.
    auto count_units = [&](double x, int unit) {
        const int exponent = exponent_of(x), shift = (exponent > 0 ? exponent : 1) - unit;
        const word digits = digits_of(x);
        Wide size = {0, 0};
        if (shift <= 0)
            size.low = digits >> -shift;
        else if (shift < 64)
            size = Wide{digits >> (64 - shift), digits << shift};
        else if (shift < 128)
            size.high = digits << (shift - 64);
        return x < 0.0 ? negate(size) : size;
    };
    auto lower = [](int x, int y) { return x < y ? x : y; };
"""


@wp.func_native(f"""
    {DECODE}
    const int top = exponent_of(bound);
    if (top == 2047)
        return {UNDETERMINED};
    const double row[3][3] = {{{{a[0], a[1], a[2]}}, {{b[0], b[1], b[2]}}, {{c[0], c[1], c[2]}}}};
    const double last[3] = {{d[0], d[1], d[2]}};
    Wide x[3][3];
    int units = 0;
    for (int i = 0; i < 3; ++i) {{
        int unit = 1 << 20;
        for (int j = 0; j < 3; ++j) {{
            if (exponent_of(row[i][j]) == 2047 || exponent_of(last[j]) == 2047)
                return {UNDETERMINED};
            unit = lower(unit, lower(lowest_bit(row[i][j]), lowest_bit(last[j])));
        }}
        if (unit == 1 << 20)
            return 0;  // a row of zeros
        for (int j = 0; j < 3; ++j)
            x[i][j] = add(count_units(row[i][j], unit), negate(count_units(last[j], unit)));
        units += unit;
    }}
    // bound < 2^(top - 1022), and the determinant is within 4 times that: within 2^126 times 2^(units - 3 * 1075)?
    if ((top > 0 ? top : 1) - 1020 > 126 + units - 3 * 1075)
        return {UNDETERMINED};
    const Wide first = multiply(x[0][0], minor(x[1][1], x[2][2], x[1][2], x[2][1]));
    const Wide second = multiply(x[0][1], minor(x[1][2], x[2][0], x[1][0], x[2][2]));
    const Wide third = multiply(x[0][2], minor(x[1][0], x[2][1], x[1][1], x[2][0]));
    return sign_of(add(add(first, second), third));
""")
def integer_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, bound: wp.float64) -> wp.int32:
    """Return the sign of det(a - d, b - d, c - d), within 4 times a bound, or UNSURE where 128 bits are too few."""
    ...


@wp.func_native(f"""
    {DECODE}
    const int top = exponent_of(bound);
    if (top == 2047)
        return {UNDETERMINED};
    const double row[2][2] = {{{{a[0], a[1]}}, {{b[0], b[1]}}}};
    const double last[2] = {{c[0], c[1]}};
    Wide x[2][2];
    int units = 0;
    for (int i = 0; i < 2; ++i) {{
        int unit = 1 << 20;
        for (int j = 0; j < 2; ++j) {{
            if (exponent_of(row[i][j]) == 2047 || exponent_of(last[j]) == 2047)
                return {UNDETERMINED};
            unit = lower(unit, lower(lowest_bit(row[i][j]), lowest_bit(last[j])));
        }}
        if (unit == 1 << 20)
            return 0;
        for (int j = 0; j < 2; ++j)
            x[i][j] = add(count_units(row[i][j], unit), negate(count_units(last[j], unit)));
        units += unit;
    }}
    if ((top > 0 ? top : 1) - 1020 > 126 + units - 2 * 1075)
        return {UNDETERMINED};
    return sign_of(minor(x[0][0], x[1][1], x[0][1], x[1][0]));
""")
def integer_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, bound: wp.float64) -> wp.int32:
    """Return the sign of det(a - c, b - c), within 4 times a bound, or UNSURE where 128 bits are too few."""
    ...
