// A sum in integers that is made word by word, lowest first, and rounded once at the end.
#pragma once
#include "builtin.h"

struct WordSum {
    typedef unsigned long long word;
    // The highest word so far that is not 0, the one below it, and whether there are bits below that.
    struct Leading {
        word top = 0, next = 0, last = 0;
        bool rest = false, below = false;
        int start = 0;

        CUDA_CALLABLE void take(word bits, int at) {
            if (bits != 0) {
                top = bits;
                next = last;
                rest = below;
                start = at;
            }
            below = below || last != 0;
            last = bits;
        }
        // To nearest, ties to even; `unit` is the exponent of the lowest bit of all.
        CUDA_CALLABLE double round(int unit) const {
            if (top == 0)
                return 0.0;
#if defined(__CUDA_ARCH__)
            const int empty = __clzll((long long)top);
#else
            const int empty = __builtin_clzll(top);
#endif
            const word head = empty > 0 ? top << empty | next >> (64 - empty) : top;
            const word odd = (head >> 11) & 1, half = head & 2047;
            const bool more = next << empty != 0 || rest;
            const word digits = (head >> 11) + (half > 1024 || (half == 1024 && (more || odd)));
            // In two steps: 2^exponent itself may be too small for a float64.
            const int exponent = unit + start - empty + 11, first = exponent / 2;
            return (double)(long long)digits * power(first) * power(exponent - first);
        }
        static CUDA_CALLABLE double power(int exponent) {
            const word bits = (word)(exponent + 1023) << 52;
            double x;
            memcpy(&x, &bits, 8);
            return x;
        }
    };
    // Two's complement: what is at hand of this word, and what goes on to the next.
    word low = 0;
    long long high = 0;
    // Of the sum, and of the sum negated, for which 1 is added below its lowest word that is not 0.
    Leading sum, negated;
    word one = 1;

    CUDA_CALLABLE void add(word bits, bool negative) {
        const word before = low;
        low = negative ? low - bits : low + bits;
        high += negative ? -(long long)(low > before) : (long long)(low < before);
    }
    CUDA_CALLABLE void end_word(int start) {
        sum.take(low, start);
        negated.take(~low + one, start);
        one = low == 0 ? one : 0;
        low = (word)high;
        high = high < 0 ? -1 : 0;
    }
    CUDA_CALLABLE double round(int unit) const { return high < 0 ? -negated.round(unit) : sum.round(unit); }
};
