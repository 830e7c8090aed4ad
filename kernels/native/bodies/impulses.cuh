// Quotients and roots of points that are relaxed, in float32.
#pragma once
#include "builtin.h"
#include "base/float32.h"

inline CUDA_CALLABLE wp::float32 divide32(wp::float32 a, wp::float32 b) { return Float32::divide(a, b); }

inline CUDA_CALLABLE wp::float32 root32(wp::float32 x) { return Float32::root(x); }
