// Radix sort on the CPU, in the caches.
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

// Sorts words by all bits from one on, by way of as much scratch; returns which of the two holds them.
inline unsigned long long* sort_words(unsigned long long* words, unsigned long long* scratch, int count, int first) {
    unsigned long long varied = 0;
    for (int i = 1; i < count; ++i)
        varied |= words[i] ^ words[0];
    for (int shift = first; shift < 64; shift += 8) {
        if ((varied >> shift & 255) == 0)
            continue;
        sort_digit(words, scratch, count, shift);
        unsigned long long* const last = words;
        words = scratch;
        scratch = last;
    }
    return words;
}
