// Quotients, roots and unit vectors of one number or vector, in float32 without branches.
#pragma once
#include "builtin.h"
#include "base/float32.h"

inline CUDA_CALLABLE wp::float32 divide32(wp::float32 a, wp::float32 b) { return Float32::divide(a, b); }

inline CUDA_CALLABLE wp::float32 root32(wp::float32 x) { return Float32::root(x); }

inline CUDA_CALLABLE wp::vec3 normalize32(wp::vec3 v) {
    return v * Float32::divide(1.0f, Float32::root(Float32::fuse(v[0], v[0], Float32::fuse(v[1], v[1], v[2] * v[2]))));
}
