// Bounds of the distance of two triangles, in float32.
#pragma once
#include "builtin.h"
#include "distance/faces32.h"

template <class Corners>
CUDA_CALLABLE void bound_faces(wp::float32 own, const Corners& a, const Corners& b, wp::float32& lower,
                               wp::float32& upper) {
    typedef NearestFaces N;
    N::Corners c;
    spread_corners(a, c.a);
    spread_corners(b, c.b);
    N::lanes size;
    const N::lanes d = N::F::root(N::measure(c, size)), error = N::error_of(d, size, own);
    lower = N::F::first(d - error);
    upper = N::F::first(d + error);
}
