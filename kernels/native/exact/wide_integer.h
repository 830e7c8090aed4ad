// Float64 numbers as digits times 2^(exponent - 1075), and integers of 128 bits that wrap.
#pragma once
#include "builtin.h"

struct WideInteger {
    typedef unsigned long long word;
    word high, low;

    static CUDA_CALLABLE word bits_of(double x) {
        word bits;
        memcpy(&bits, &x, 8);
        return bits;
    }
    static CUDA_CALLABLE int exponent_of(double x) { return (int)((bits_of(x) >> 52) & 2047); }
    static CUDA_CALLABLE int scale_of(double x) { return exponent_of(x) > 0 ? exponent_of(x) : 1; }
    static CUDA_CALLABLE word digits_of(double x) {
        const word digits = bits_of(x) & ((1ull << 52) - 1);
        return exponent_of(x) > 0 ? digits | (1ull << 52) : digits;
    }
    // 0 has no lowest bit.
    static CUDA_CALLABLE int lowest_bit(double x) {
        const word digits = digits_of(x);
        if (digits == 0)
            return 1 << 20;
#if defined(__CUDA_ARCH__)
        return scale_of(x) + __ffsll((long long)digits) - 1;
#else
        return scale_of(x) + __builtin_ctzll(digits);
#endif
    }
    static CUDA_CALLABLE WideInteger negate(const WideInteger& x) {
        return WideInteger{~x.high + (x.low == 0), 0 - x.low};
    }
    static CUDA_CALLABLE WideInteger add(const WideInteger& x, const WideInteger& y) {
        const word low = x.low + y.low;
        return WideInteger{x.high + y.high + (low < x.low), low};
    }
    static CUDA_CALLABLE WideInteger multiply_words(word x, word y) {
#if defined(__CUDA_ARCH__)
        return WideInteger{__umul64hi(x, y), x * y};
#else
        return WideInteger{(word)(((unsigned __int128)x * y) >> 64), x * y};
#endif
    }
    static CUDA_CALLABLE WideInteger multiply(const WideInteger& x, const WideInteger& y) {
        const WideInteger low = multiply_words(x.low, y.low);
        return WideInteger{low.high + x.high * y.low + x.low * y.high, low.low};
    }
    static CUDA_CALLABLE WideInteger minor(const WideInteger& a, const WideInteger& b, const WideInteger& c,
                                           const WideInteger& d) {
        return add(multiply(a, b), negate(multiply(c, d)));
    }
    static CUDA_CALLABLE int sign_of(const WideInteger& x) {
        return (long long)x.high < 0 ? -1 : (x.high | x.low) != 0;
    }
    // In units of 2^(unit - 1075), no larger than its lowest bit, modulo 2^128.
    static CUDA_CALLABLE WideInteger count_units(double x, int unit) {
        const int shift = scale_of(x) - unit;
        const word digits = digits_of(x);
        WideInteger size = {0, 0};
        if (shift <= 0)
            size.low = digits >> -shift;
        else if (shift < 64)
            size = WideInteger{digits >> (64 - shift), digits << shift};
        else if (shift < 128)
            size.high = digits << (shift - 64);
        return x < 0.0 ? negate(size) : size;
    }
    // 64 bits of |x y z|, from 2^(unit - 3 * 1075) on.
    static CUDA_CALLABLE word product_word(double x, double y, double z, int unit) {
        const int at = unit - (scale_of(x) + scale_of(y) + scale_of(z));
        if (at >= 160 || at <= -64 || x == 0.0 || y == 0.0 || z == 0.0)
            return 0;
        const WideInteger p = multiply_words(digits_of(x), digits_of(y));
        const WideInteger low = multiply_words(p.low, digits_of(z)), high = multiply_words(p.high, digits_of(z));
        const WideInteger upper = add(high, WideInteger{0, low.high});
        if (at < 0)
            return low.low << -at;
        const word first = at < 64 ? low.low : at < 128 ? upper.low : upper.high;
        const word second = at < 64 ? upper.low : at < 128 ? upper.high : 0;
        return at % 64 > 0 ? first >> at % 64 | second << (64 - at % 64) : first;
    }
    static CUDA_CALLABLE int lower(int x, int y) { return x < y ? x : y; }
};
