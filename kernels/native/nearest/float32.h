// Numbers and points of one pair of faces, in the place of those of simd/float32.h.
#pragma once
#include "builtin.h"

struct Float32 {
    typedef float lanes;
    typedef bool bits;
    struct Point {
        float x, y, z;
    };
    static CUDA_CALLABLE float absolute(float v) { return v < 0.0f ? -v : v; }
    static CUDA_CALLABLE float fuse(float a, float b, float c) { return fmaf(a, b, c); }
    static CUDA_CALLABLE Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static CUDA_CALLABLE Point cross(const Point& u, const Point& v) {
        return Point{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))};
    }
    static CUDA_CALLABLE float dot(const Point& u, const Point& v) { return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }
    static CUDA_CALLABLE Point choose(bool which, const Point& a, const Point& b) { return which ? a : b; }
};
