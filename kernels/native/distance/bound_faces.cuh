// Bounds of the distance of two triangles, in float32.
#pragma once
#include "builtin.h"
#include "distance/faces32.h"

template <class Corners>
CUDA_CALLABLE void bound_faces(wp::float32 own, const Corners& a, const Corners& b, wp::float32& lower,
                               wp::float32& upper) {
    typedef NearestFaces N;
    N::Corners c;
    const N::lanes zero = {};
    for (int k = 0; k < 3; ++k) {
        c.a[k] = N::Point{zero + a.data[k][0], zero + a.data[k][1], zero + a.data[k][2]};
        c.b[k] = N::Point{zero + b.data[k][0], zero + b.data[k][1], zero + b.data[k][2]};
    }
    N::lanes size;
    const N::lanes d = N::F::root(N::measure(c, size)), error = N::error_of(d, size, own);
    lower = N::F::first(d - error);
    upper = N::F::first(d + error);
}
