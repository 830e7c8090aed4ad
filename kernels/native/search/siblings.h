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
