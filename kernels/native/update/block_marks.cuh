// Marks of one tree state, a bit each, in the shared memory of its block; on the CPU in an array that is given.
#pragma once
#include "builtin.h"
#include "base/shared.cuh"
#include "base/sizes.h"

template <int WORDS>
CUDA_CALLABLE wp::uint64 marks_of(wp::array_t<wp::uint32> scratch) {
#if defined(__CUDA_ARCH__)
    __shared__ unsigned int words[WORDS];
    return (unsigned int)__cvta_generic_to_shared(words);
#else
    return (wp::uint64)scratch.data;
#endif
}

inline CUDA_CALLABLE wp::uint64 block_marks(wp::array_t<wp::uint32> scratch) { return marks_of<MARK_WORDS>(scratch); }

inline CUDA_CALLABLE wp::uint64 shallow_marks(wp::array_t<wp::uint32> scratch) {
    return marks_of<SHALLOW_WORDS>(scratch);
}

inline CUDA_CALLABLE wp::uint32 read_word(wp::uint64 marks, wp::int32 i) {
    return *entry<volatile unsigned int>(marks, i);
}

inline CUDA_CALLABLE void clear_word(wp::uint64 marks, wp::int32 i) { *entry<volatile unsigned int>(marks, i) = 0; }

inline CUDA_CALLABLE void add_to_word(wp::uint64 marks, wp::int32 i, wp::int32 amount) {
#if defined(__CUDA_ARCH__)
    atomicAdd(entry<unsigned int>(marks, i), (unsigned int)amount);
#else
    *entry<unsigned int>(marks, i) += amount;
#endif
}

inline CUDA_CALLABLE bool mark_bit(wp::uint64 marks, wp::int32 bit) {
    const unsigned int mask = 1u << (bit & 31);
    unsigned int* const word = entry<unsigned int>(marks, bit >> 5);
#if defined(__CUDA_ARCH__)
    const unsigned int old = atomicOr(word, mask);
#else
    const unsigned int old = *word;
    *word = old | mask;
#endif
    return (old & mask) == 0;
}

inline CUDA_CALLABLE bool unmark_bit(wp::uint64 marks, wp::int32 bit) {
    const unsigned int mask = 1u << (bit & 31);
    unsigned int* const word = entry<unsigned int>(marks, bit >> 5);
#if defined(__CUDA_ARCH__)
    // What this thread has written stands before the bit goes, and is read by the thread that finds it gone.
    __threadfence_block();
    const unsigned int old = atomicAnd(word, ~mask);
    __threadfence_block();
#else
    const unsigned int old = *word;
    *word = old & ~mask;
#endif
    return (old & mask) != 0;
}

inline CUDA_CALLABLE void fetch_entry(wp::array_t<wp::vec4> values, wp::int64 i) {
#if defined(__CUDA_ARCH__)
    // A load whose result nobody waits for.
    asm volatile("{ .reg .b32 unused; ld.global.ca.b32 unused, [%0]; }" ::"l"((const float4*)values.data + i));
#endif
}

inline CUDA_CALLABLE void fetch_corner(wp::array_t<wp::vec4i> values, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    asm volatile("{ .reg .b32 unused; ld.global.ca.b32 unused, [%0]; }" ::"l"((const int4*)values.data + i));
#endif
}
