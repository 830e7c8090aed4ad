// Convex polygons, cut by planes. Who measures the distances of corners gives what measures a new one.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

// A corner of a polygon, and where its distances to faces stand.
struct Corner {
    double x, y, z;
    const double* distance;
};

struct Polygon {
    int count;
    Corner corner[POLYGON_CORNERS];

    Polygon() : count(0) {}
    Polygon(const Polygon& other) { *this = other; }
    // The corners in use alone.
    Polygon& operator=(const Polygon& other) {
        count = other.count;
        for (int i = 0; i < count; ++i)
            corner[i] = other.corner[i];
        return *this;
    }
    const Corner& next(int i) const { return corner[i + 1 < count ? i + 1 : 0]; }
    Corner middle() const {
        Corner sum = {0.0, 0.0, 0.0, nullptr};
        for (int k = 0; k < count; ++k) {
            sum.x += corner[k].x;
            sum.y += corner[k].y;
            sum.z += corner[k].z;
        }
        return Corner{sum.x / count, sum.y / count, sum.z / count, nullptr};
    }
};

struct Plane {
    double normal[3], origin[3];
    double height(const Corner& p) const {
        return normal[0] * (p.x - origin[0]) + normal[1] * (p.y - origin[1]) + normal[2] * (p.z - origin[2]);
    }
};

// Keep the side of the normal, and write the rest; false where a corner cannot be measured. Corners within `margin` of
// the plane belong to both sides, which prevents slivers. Not inlined: it has many callers, and compiling takes long.
template <class Measure>
__attribute__((noinline)) bool cut_polygon(Polygon& p, Polygon& rest, const Plane& plane, double margin,
                                           Measure& measure) {
    double height[POLYGON_CORNERS];
    int above = 0, below = 0;
    for (int i = 0; i < p.count; ++i) {
        height[i] = plane.height(p.corner[i]);
        above += height[i] > margin;
        below += height[i] < -margin;
    }
    rest.count = 0;
    if (below == 0)
        return true;
    if (above == 0) {
        rest = p;
        p.count = 0;
        return true;
    }
    Polygon kept;
    for (int i = 0; i < p.count; ++i) {
        const int j = i + 1 < p.count ? i + 1 : 0;
        const Corner &u = p.corner[i], &v = p.corner[j];
        const bool inside = height[i] >= -margin;
        (inside ? kept.corner[kept.count++] : rest.corner[rest.count++]) = u;
        if (inside != (height[j] >= -margin)) {
            double t = height[i] / (height[i] - height[j]);
            t = t < 0.0 ? 0.0 : t > 1.0 ? 1.0 : t;
            Corner x = {u.x + (v.x - u.x) * t, u.y + (v.y - u.y) * t, u.z + (v.z - u.z) * t, nullptr};
            if (!measure(x))
                return false;
            kept.corner[kept.count++] = rest.corner[rest.count++] = x;
        }
    }
    p = kept;
    return true;
}

// Cut across the longest edge.
template <class Measure>
bool halve_polygon(Polygon& p, Polygon& rest, Measure& measure) {
    double longest = -1.0;
    int edge = 0;
    for (int i = 0; i < p.count; ++i) {
        const double x = p.next(i).x - p.corner[i].x, y = p.next(i).y - p.corner[i].y, z = p.next(i).z - p.corner[i].z;
        const double size = x * x + y * y + z * z;
        if (size > longest) {
            longest = size;
            edge = i;
        }
    }
    const Corner &u = p.corner[edge], &v = p.next(edge);
    const double way[3] = {v.x - u.x, v.y - u.y, v.z - u.z};
    const double size = wp::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    Plane plane = {{0.0, 0.0, 0.0}, {u.x + way[0] * 0.5, u.y + way[1] * 0.5, u.z + way[2] * 0.5}};
    for (int k = 0; k < 3 && size > 0.0; ++k)
        plane.normal[k] = way[k] / size;
    return cut_polygon(p, rest, plane, 0.0, measure);
}

// Cut by the sides of a prism, so many of them, or in half if that leaves it whole. Puts at most 4 parts on a stack and
// returns the new top, -1 where a corner cannot be measured.
template <class Measure>
int split_polygon(Polygon& p, Polygon* stack, int top, const Plane (&side)[3], int sides, double margin,
                  Measure& measure) {
    const int bottom = top;
    for (int k = 0; k < sides && p.count > 0; ++k) {
        if (!cut_polygon(p, stack[top], side[k], margin, measure))
            return -1;
        top += stack[top].count > 0;
    }
    if (p.count > 0)
        stack[top++] = p;
    if (top - bottom == 1) {
        Polygon whole = stack[bottom];
        if (!halve_polygon(whole, stack[bottom], measure))
            return -1;
        top = bottom + (stack[bottom].count > 0);
        if (whole.count > 0)
            stack[top++] = whole;
    }
    return top;
}
