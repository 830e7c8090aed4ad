// Distances of pairs of faces in float32, within an error that is known: as `nearest_features`.
#pragma once
#include "builtin.h"
#include "base/float32.h"

struct NearestFaces {
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    struct Corners {
        Point a[3], b[3];
    };
    static CUDA_CALLABLE lanes clamp(const lanes& x) { return F::least(F::most(x, lanes{}), lanes{} + 1.0f); }
    static CUDA_CALLABLE Point add(const Point& p, const lanes& s, const Point& v) {
        return Point{F::fuse(s, v.x, p.x), F::fuse(s, v.y, p.y), F::fuse(s, v.z, p.z)};
    }
    static CUDA_CALLABLE lanes minor(const lanes& a, const lanes& b, const lanes& c, const lanes& d) {
        const lanes w = c * d;
        return F::fuse(a, b, -w) - F::fuse(c, d, -w);
    }
    static CUDA_CALLABLE Point cross_exactly(const Point& u, const Point& v) {
        return Point{minor(u.y, v.z, u.z, v.y), minor(u.z, v.x, u.x, v.z), minor(u.x, v.y, u.y, v.x)};
    }
    static CUDA_CALLABLE lanes largest(const Point& p) {
        return F::largest(F::absolute(p.x), F::absolute(p.y), F::absolute(p.z));
    }

    // From edge e to f, r from its start to that of f, and the parameter on e.
    static CUDA_CALLABLE Point between_edges(const Point& r, const Point& e, const Point& f, const lanes& inverse_e,
                                             const lanes& inverse_f, lanes& s) {
        const Point n = F::cross(e, f);
        s = clamp(F::dot(F::cross(r, f), n) * F::invert(F::dot(n, n)));
        const lanes t = clamp((F::dot(e, f) * s - F::dot(r, f)) * inverse_f);
        s = clamp(F::dot(add(r, t, f), e) * inverse_e);
        return add(add(r, t, f), -s, e);
    }
    static CUDA_CALLABLE Point over_face(const Point& w, const Point& e1, const Point& e2, const Point& n,
                                         const lanes& inverse) {
        const Point level = add(w, -F::dot(w, n) * inverse, n);
        const lanes x = F::dot(cross_exactly(level, e2), n) * inverse;
        const lanes y = F::dot(cross_exactly(e1, level), n) * inverse;
        const Point v = add(add(w, -x, e1), -y, e2);
        const bits inside = (inverse > 0.0f) & (x >= 0.0f) & (y >= 0.0f) & (x + y <= 1.0f);
        const lanes far = lanes{} + 0x1p60f;
        return Point{inside ? v.x : far, inside ? v.y : far, inside ? v.z : far};
    }
    // Offers what joins all edges, and corners and faces, to a keeper; returns the largest coordinate of what joins
    // corners.
    template <class Keeper>
    static CUDA_CALLABLE lanes visit(const Corners& c, Keeper& keeper) {
        const Point e[3] = {F::minus(c.a[1], c.a[0]), F::minus(c.a[2], c.a[1]), F::minus(c.a[0], c.a[2])};
        const Point f[3] = {F::minus(c.b[1], c.b[0]), F::minus(c.b[2], c.b[1]), F::minus(c.b[0], c.b[2])};
        lanes inverse_e[3], inverse_f[3], size = {}, s;
        for (int k = 0; k < 3; ++k) {
            inverse_e[k] = F::invert(F::dot(e[k], e[k]));
            inverse_f[k] = F::invert(F::dot(f[k], f[k]));
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const Point r = F::minus(c.b[j], c.a[i]);
                size = F::most(size, largest(r));
                const Point v = between_edges(r, e[i], f[j], inverse_e[i], inverse_f[j], s);
                keeper.offer_edges(v, c.a[i], s, e[i]);
            }
        const Point back_a = F::minus(c.a[2], c.a[0]), back_b = F::minus(c.b[2], c.b[0]);
        const Point n = cross_exactly(e[0], back_a), m = cross_exactly(f[0], back_b);
        const lanes inverse_n = F::invert(F::dot(n, n)), inverse_m = F::invert(F::dot(m, m));
        for (int k = 0; k < 3; ++k) {
            keeper.offer_corner_of_b(over_face(F::minus(c.b[k], c.a[0]), e[0], back_a, n, inverse_n), c.b[k]);
            keeper.offer_corner_of_a(over_face(F::minus(c.a[k], c.b[0]), f[0], back_b, m, inverse_m), c.a[k]);
        }
        return F::most(F::most(size, largest(e[0])), F::most(largest(back_a), F::most(largest(f[0]), largest(back_b))));
    }
    struct Nearest {
        lanes square;
        CUDA_CALLABLE void offer(const Point& v) { square = F::least(square, F::dot(v, v)); }
        CUDA_CALLABLE void offer_edges(const Point& v, const Point&, const lanes&, const Point&) { offer(v); }
        CUDA_CALLABLE void offer_corner_of_b(const Point& v, const Point&) { offer(v); }
        CUDA_CALLABLE void offer_corner_of_a(const Point& v, const Point&) { offer(v); }
    };
    // Squared distances, and the largest coordinate of what joins corners.
    static CUDA_CALLABLE lanes measure(const Corners& c, lanes& size) {
        Nearest nearest = {lanes{} + 0x1.fffffep127f};
        size = visit(c, nearest);
        return nearest.square;
    }
    // What distances err by: over 48 u L where they are small. `own` is what coordinates make of it.
    static CUDA_CALLABLE lanes error_of(const lanes& d, const lanes& size, float own) {
        return size * (d > size * 0x1p-10f ? lanes{} + 48 * 0x1p-24f : lanes{} + 256 * 0x1p-24f) + own;
    }
};
