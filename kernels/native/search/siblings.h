// The pairs of nodes that an item of the CPU's traversals stands for.
#pragma once
#include "builtin.h"

// Siblings lie side by side, so an item loads both, and names those of the four pairs that are in use: of two siblings
// the first (even), the second (odd) or both (s), in A, times the same in B. Four bits for each choice, by the item's
// bits that say so, from the highest: A is odd, s of B, B is odd, s of A.
inline unsigned int pairs_in_use(wp::int64 item) {
    constexpr unsigned long long PAIRS_USED = 0xfcfca854f3f3a251;
    const unsigned long long turned = ((unsigned long long)item << 1) | ((unsigned long long)item >> 63);
    return (unsigned int)(PAIRS_USED >> (((turned & 3) << 2) | ((turned >> 28) & 48))) & 15;
}

// The records of both siblings of A, and of B, 32 bytes each, and which of their four pairs are in use.
struct Siblings {
    const char *a, *b;
    unsigned int used;
};

// Returns the siblings of an item, which the core begins to load.
inline Siblings take_siblings(const char* tree_a, const char* tree_b, wp::int64 item) {
    const unsigned int x = (unsigned int)(item >> 32), y = (unsigned int)item;
    const Siblings taken = {tree_a + 32 * (wp::int64)(x & 0x7ffffffe), tree_b + 32 * (wp::int64)(y & 0x7ffffffe),
                            pairs_in_use(item)};
    __builtin_prefetch(taken.a);
    __builtin_prefetch(taken.b);
    return taken;
}
