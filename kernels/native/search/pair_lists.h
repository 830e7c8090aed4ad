// Lists of the CPU's traversals: of node pairs and face pairs that follow from four pairs of nodes that may intersect.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

struct PairLists {
    typedef float eight __attribute__((vector_size(32)));
    typedef int ints __attribute__((vector_size(32)));
    typedef wp::int64 longs __attribute__((vector_size(32)));
    typedef wp::int64 loose_longs __attribute__((vector_size(32), aligned(8)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    wp::int64 *items, *found;
    int end, waiting;

    // How many items may be taken at once, so that what follows from them fits.
    int fitting(int most) const {
        const int room = (CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH - end) / 3, fits = room > 1 ? room : 1;
        const int wanted = most < fits ? most : fits;
        return wanted < end ? wanted : end;
    }
    // As `item_of`, of the pairs that a mask names: of A for the four pairs, then of B.
    __attribute__((always_inline)) void append(const ints& skip, const ints& face, unsigned int mask) {
        const ints other = __builtin_shufflevector(face, face, 4, 5, 6, 7, 0, 1, 2, 3);
        const eight span = (eight)face, other_span = (eight)other;
        const ints inner = (face | other) < 0, down = (face < 0) & (span + span <= other_span);
        const ints next = inner ? (down ? (skip + skip) | (1 << 31) : skip) : face;
        const longs pairs = (longs)__builtin_shufflevector(next, next, 4, 0, 5, 1, 6, 2, 7, 3);
        const unsigned int go = mask & __builtin_bit_cast(unsigned char, __builtin_convertvector(inner, flags));
        const unsigned int leaves = mask & ~go;
#if defined(__AVX512VL__)
        *(loose_longs*)(items + end) = __builtin_ia32_compressdi256_mask(pairs, longs{}, go);
        *(loose_longs*)(found + waiting) = __builtin_ia32_compressdi256_mask(pairs, longs{}, leaves);
        end += __builtin_popcount(go);
        waiting += __builtin_popcount(leaves);
#else
// Without branches, which could not be predicted; what is not in use is written over.
#pragma clang loop unroll(full)
        for (int k = 0; k < 4; ++k) {
            items[end] = found[waiting] = pairs[k];
            end += (go >> k) & 1;
            waiting += (leaves >> k) & 1;
        }
#endif
    }
};
