// One pass of a radix sort on the CPU.
#pragma once
#include "builtin.h"

// Moves words to another place in the order of the eight bits from one on, equal ones in the order that they had.
inline void sort_digit(const unsigned long long* from, unsigned long long* to, int count, int shift) {
    unsigned int place[256] = {};
    for (int i = 0; i < count; ++i)
        ++place[from[i] >> shift & 255];
    for (unsigned int digit = 0, sum = 0; digit < 256; ++digit) {
        const unsigned int own = place[digit];
        place[digit] = sum;
        sum += own;
    }
    for (int i = 0; i < count; ++i)
        to[place[from[i] >> shift & 255]++] = from[i];
}
