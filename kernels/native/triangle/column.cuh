// Columns of faces along a direction: what lies of another face within one, its corners and their depths; of one pair
// in a thread, of 8 on the CPU.
#pragma once
#include "builtin.h"
#include "base/points64.cuh"
#include "base/sizes.h"

// A face seen at a smaller cosine along a direction says nothing about depth in that direction.
constexpr double FACING = 0.1;
// By which part of a face's size its column is wider, so that walls that stand on its rim are inside.
constexpr double COLUMN_SLACK = 0x1p-36;
// Part of the size of faces that depths in a column err by.
constexpr double COLUMN_ROUNDING = 0x1p-46;

template <class Number>
struct Columns : Points64<Number> {
    typedef Points64<Number> F;
    typedef typename F::lanes lanes;
    typedef typename F::bits bits;
    typedef typename F::Point Point;
    using F::choose, F::dot, F::greater, F::lesser, F::minus, F::negate;

    // The faces of the pair's first object and of its second, A's frame.
    struct Faces {
        Point a[3], b[3];
    };
    // Depth of a column that holds no corner.
    static CUDA_CALLABLE lanes no_depth() { return lanes{} - INFINITY; }
    // One of three points; on a GPU they are in registers, which have no address.
    static CUDA_CALLABLE Point get(const Point (&p)[3], int k) {
#if defined(__CUDA_ARCH__)
        return choose(k == 0, p[0], choose(k == 1, p[1], p[2]));
#else
        return p[k];
#endif
    }
    static CUDA_CALLABLE Point go(const Point& p, const Point& way, const lanes& t) {
        return Point{p.x + way.x * t, p.y + way.y * t, p.z + way.z * t};
    }
    // What depths in a column err by at most: a part of the size of both faces.
    static CUDA_CALLABLE lanes find_slack(const Faces& f) {
        lanes size = greater(F::largest(minus(f.a[1], f.a[0])), F::largest(minus(f.a[2], f.a[0])));
        size = greater(size, greater(F::largest(minus(f.b[0], f.a[0])), F::largest(minus(f.b[1], f.a[0]))));
        return COLUMN_ROUNDING * greater(size, F::largest(minus(f.b[2], f.a[0])));
    }

    // The column of one face along a normal, and the face that it cuts. The corners of what lies of that within it are
    // the ends of its edges, clipped, and where the column's edges pierce it: nine at most, each of them once.
    struct Column {
        Point normal;    // unit, from the pair's first object to its second
        bits looks;      // whether the face looks along it: else it cuts nothing
        Point plane;     // the face's normal over its cosine with the column's
        Point u[3];      // corners of the face
        Point v[3];      // corners of the other one
        Point side[3];   // normals of the column's sides, inwards, of any length
        lanes slack[3];  // by which each side is wider, times that length

        // Of the face that looks more along n.
        CUDA_CALLABLE Column(const Faces& f, const Point& n, const Point& normal_a, const Point& normal_b) {
            const lanes facing_a = dot(n, normal_a), facing_b = -dot(n, normal_b);
            const bits other = facing_b > facing_a;
            const lanes facing = greater(facing_a, facing_b);
            normal = n;
            looks = negate(facing < FACING);
            plane = choose(other, normal_b, normal_a);
            plane = Point{plane.x / facing, plane.y / facing, plane.z / facing};
            for (int k = 0; k < 3; ++k) {
                u[k] = choose(other, f.b[k], f.a[k]);
                v[k] = choose(other, f.a[k], f.b[k]);
            }
            for (int k = 0; k < 3; ++k) {
                const Point edge = minus(u[(k + 1) % 3], u[k]), across = minus(u[(k + 2) % 3], u[k]);
                const Point out = F::cross(edge, n);
                side[k] = choose(dot(out, across) < 0.0, negate(out), out);
                slack[k] = COLUMN_SLACK * (F::sum_sizes(edge) + F::sum_sizes(across)) * F::sum_sizes(side[k]);
            }
        }
        CUDA_CALLABLE lanes depth_of(const Point& point) const { return dot(minus(u[0], point), plane); }
        // Between which parameters an edge lies within the column, the first more where it does not.
        struct Range {
            lanes low, high;
            CUDA_CALLABLE bits exists() const { return low <= high; }
            // Whether the edge leaves the column before its end, which is where the next one starts.
            CUDA_CALLABLE bits leaves() const { return (high < 1.0) & (low < high); }
        };
        // Heights of a point over the column's sides.
        struct Heights {
            lanes side[3];
        };
        CUDA_CALLABLE Heights over_sides(const Point& point) const {
            Heights x;
            for (int k = 0; k < 3; ++k)
                x.side[k] = dot(side[k], minus(point, u[k])) + slack[k];
            return x;
        }
        // Clips edge i of the other face, from p to q; takes the heights of p, and leaves those of q.
        CUDA_CALLABLE Range clip(int i, Heights& heights, Point& p, Point& q) const {
            p = get(v, i);
            q = get(v, i == 2 ? 0 : i + 1);
            const Heights before = heights;
            heights = over_sides(q);
            Range range = {lanes{}, lanes{} + 1.0};
            for (int k = 0; k < 3; ++k) {
                const lanes at_p = before.side[k], at_q = heights.side[k];
                const bits p_out = at_p < 0.0, q_out = at_q < 0.0, out = p_out & q_out;
                lanes t = {};
                if (Number::any(p_out ^ q_out))
                    t = at_p / (at_p - at_q);
                range.low = out ? lanes{} + 2.0 : (p_out ? greater(range.low, t) : range.low);
                range.high = out ? lanes{} + 1.0 : (q_out ? lesser(range.high, t) : range.high);
            }
            return range;
        }
        // Where the edge of the column at corner i of its face pierces the other face; returns whether it does.
        CUDA_CALLABLE bits pierce(int i, Point& point) const {
            const Point m = F::cross(minus(v[1], v[0]), minus(v[2], v[0]));
            const lanes along = dot(normal, m);
            point = get(u, i);
            point = go(point, normal, dot(minus(v[0], point), m) / along);
            bits inside = along != 0.0;
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                if (!Number::any(inside))
                    return inside;
                const Point edge = minus(v[(k + 1) % 3], v[k]);
                inside &= dot(F::cross(edge, minus(point, v[k])), m) > 0.0;
            }
            return inside;
        }
        // How deep the deepest corner is that is deep enough: from `least` on, 0 or minus the gap.
        CUDA_CALLABLE lanes find_depth(const lanes& least) const {
            lanes depth = no_depth();
            auto raise = [&](const bits& exists, const lanes& x) {
                depth = (exists & (x >= least)) ? greater(depth, x) : depth;
            };
            if (!Number::any(looks))
                return depth;
            Heights heights = over_sides(v[0]);
#pragma unroll 1
            for (int i = 0; i < 3; ++i) {
                Point p, q;
                const Range range = clip(i, heights, p, q);
                // Depth is linear along the edge.
                const lanes at_p = depth_of(p), at_q = depth_of(q);
                raise(range.exists(), at_p + (at_q - at_p) * range.low);
                raise(range.exists() & range.leaves(), at_p + (at_q - at_p) * range.high);
                const bits pierces = pierce(i, p);
                raise(pierces, depth_of(p));
            }
            return looks ? depth : no_depth();
        }
        // Offers the corners of what the column cuts, and their depths, to a keeper.
        template <class Keeper>
        CUDA_CALLABLE void visit(Keeper& keeper) const {
            Heights heights = over_sides(v[0]);
#pragma unroll 1
            for (int i = 0; i < 3; ++i) {
                Point p, q;
                const Range range = clip(i, heights, p, q);
                const Point way = minus(q, p);
#pragma unroll 1
                for (int k = 0; k < 2; ++k) {
                    const lanes t = k == 0 ? range.low : range.high;
                    const Point end = choose(t > 0.0, go(p, way, t), p);
                    keeper.offer(end, depth_of(end), k == 0 ? range.exists() : range.exists() & range.leaves());
                }
            }
#pragma unroll 1
            for (int i = 0; i < 3; ++i) {
                Point p;
                const bits pierces = pierce(i, p);
                keeper.offer(p, depth_of(p), pierces);
            }
        }
    };
    // The normal of a column, and how deep one face is in that of the other.
    struct Measured {
        Point normal;
        lanes depth;
        lanes slack;  // that depths of corners may lack
    };
    static CUDA_CALLABLE Measured measure(const Faces& f, const Point& n, const Point& normal_a, const Point& normal_b,
                                          const lanes& least) {
        return Measured{n, Column(f, n, normal_a, normal_b).find_depth(least), lanes{}};
    }
};
