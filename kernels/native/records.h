// Stores at any byte, whatever the alignment.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE void store_flag(wp::array_t<wp::int64> words, wp::int64 at, wp::int32 flag) {
    ((wp::uint8*)words.data)[at] = (wp::uint8)flag;
}

inline CUDA_CALLABLE void store_bits(wp::array_t<wp::uint8> bytes, wp::int32 at, wp::int32 size, wp::int64 bits) {
    for (int k = 0; k < size; ++k)
        bytes.data[at + k] = (wp::uint8)(bits >> (8 * k));
}

inline CUDA_CALLABLE wp::float32 round_to_float32(wp::float64 x) {
    // NumPy's NaN: devices differ in the sign and payload of the NaN that a conversion makes.
    union {
        wp::int32 bits;
        wp::float32 x;
    } nan = {0x7fc00000};
    return x == x ? (wp::float32)x : nan.x;
}
