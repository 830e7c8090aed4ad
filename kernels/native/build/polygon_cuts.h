// Convex polygons on a stack, cut by planes; new corners are measured at once.
#pragma once
#include "builtin.h"
#include "build/near_faces.h"

struct PolygonCuts {
    NearFaces near;
    Polygon stack[POLYGON_STACK];
    alignas(64) double distance[DISTANCE_ROOM];
    int rows;

    // The triangle alone on the stack.
    void start(const double* corner) {
        const int row = 8 * near.groups;
        stack[0].count = rows = 3;
        for (int k = 0; k < 3; ++k) {
            stack[0].corner[k] = Corner{corner[3 * k], corner[3 * k + 1], corner[3 * k + 2], distance + row * k};
            near.measure(stack[0].corner[k], distance + row * k);
        }
    }
    // As `cut_polygon`; false where there is no room for distances.
    __attribute__((noinline)) bool cut(Polygon& p, Polygon& rest, const double (&normal)[3], const double (&origin)[3],
                                       double margin) {
        double height[POLYGON_CORNERS];
        int above = 0, below = 0;
        for (int i = 0; i < p.count; ++i) {
            const Corner& q = p.corner[i];
            height[i] = normal[0] * (q.x - origin[0]) + normal[1] * (q.y - origin[1]) + normal[2] * (q.z - origin[2]);
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
        kept.count = 0;
        for (int i = 0; i < p.count; ++i) {
            const int j = i + 1 < p.count ? i + 1 : 0;
            const Corner &u = p.corner[i], &v = p.corner[j];
            const bool inside = height[i] >= -margin;
            (inside ? kept.corner[kept.count++] : rest.corner[rest.count++]) = u;
            if (inside != (height[j] >= -margin)) {
                const int row = 8 * near.groups;
                if ((rows + 1) * row > DISTANCE_ROOM)
                    return false;
                double t = height[i] / (height[i] - height[j]);
                t = t < 0.0 ? 0.0 : t > 1.0 ? 1.0 : t;
                double* found = distance + row * rows++;
                const Corner x = {u.x + (v.x - u.x) * t, u.y + (v.y - u.y) * t, u.z + (v.z - u.z) * t, found};
                near.measure(x, found);
                kept.corner[kept.count++] = rest.corner[rest.count++] = x;
            }
        }
        p = kept;
        return true;
    }
    // As `halve_polygon`.
    bool halve(Polygon& p, Polygon& rest) {
        double longest = -1.0;
        int edge = 0;
        auto next = [&](int i) -> const Corner& { return p.corner[i + 1 < p.count ? i + 1 : 0]; };
        for (int i = 0; i < p.count; ++i) {
            const double x = next(i).x - p.corner[i].x, y = next(i).y - p.corner[i].y, z = next(i).z - p.corner[i].z;
            const double size = x * x + y * y + z * z;
            if (size > longest) {
                longest = size;
                edge = i;
            }
        }
        const Corner u = p.corner[edge], v = next(edge);
        const double way[3] = {v.x - u.x, v.y - u.y, v.z - u.z};
        const double size = wp::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        double normal[3] = {0.0, 0.0, 0.0};
        for (int k = 0; k < 3 && size > 0.0; ++k)
            normal[k] = way[k] / size;
        const double middle[3] = {u.x + way[0] * 0.5, u.y + way[1] * 0.5, u.z + way[2] * 0.5};
        return cut(p, rest, normal, middle, 0.0);
    }
    // As `split_polygon`: the new top, or -1 where there is no room for distances.
    int split(Polygon& p, int top, int over, double margin) {
        FaceLanes& lane = near.group[over >> 3];
        const int bottom = top, i = over & 7;
        if (!lane.has_sides)
            lane.find_sides();
        for (int k = 0; k < 3 && lane.has_area[i] && p.count > 0; ++k) {
            const FaceLanes::Point &side = lane.side[k], &start = k == 0 ? lane.a : k == 1 ? lane.b : lane.c;
            const double normal[3] = {side.x[i], side.y[i], side.z[i]};
            const double origin[3] = {start.x[i], start.y[i], start.z[i]};
            if (!cut(p, stack[top], normal, origin, margin))
                return -1;
            top += stack[top].count > 0;
        }
        if (p.count > 0)
            stack[top++] = p;
        if (top - bottom == 1) {
            Polygon whole = stack[bottom];
            if (!halve(whole, stack[bottom]))
                return -1;
            top = bottom + (stack[bottom].count > 0);
            if (whole.count > 0)
                stack[top++] = whole;
        }
        return top;
    }
    // As `split_polygon` by the face nearest to the middle.
    int split_at_middle(Polygon& p, int top, double limit) {
        Corner middle = {0.0, 0.0, 0.0, nullptr};
        for (int k = 0; k < p.count; ++k) {
            middle.x += p.corner[k].x;
            middle.y += p.corner[k].y;
            middle.z += p.corner[k].z;
        }
        middle.x /= p.count;
        middle.y /= p.count;
        middle.z /= p.count;
        alignas(64) double row[NEAR_ROOM];
        double here;
        near.measure(middle, row);
        return split(p, top, near.nearest(row, here), 0x1p-46 + 0.05 * wp::sqrt(limit));
    }
    // As `cover_triangle`, of the one polygon on the stack; false where that has to do it.
    bool cover(double& limit, int (&used)[COVER_SLOTS], int& count) {
        int top = 1, split = 0;
        count = 0;
        while (top > 0) {
            Polygon p = stack[--top];
            double bound;
            const int best = near.cover(p, limit, bound);
            bool final = bound <= limit;
            if (!final) {
                const double least = near.reach(p);
                if (least > limit)
                    return false;  // another face may be nearer
                const double enough = 1.1 * least > limit ? 1.1 * least : limit;
                final =
                    bound <= enough || split >= COVER_CUTS || top + 4 >= POLYGON_STACK || p.count + 4 > POLYGON_CORNERS;
            }
            if (final) {
                int at = 0;
                while (at < count && used[at] != best)
                    ++at;
                if (at == COVER_SLOTS)
                    return false;
                count += at == count;
                used[at] = used[count - 1];
                used[count - 1] = best;
                limit = bound > limit ? bound : limit;
            } else {
                ++split;
                top = split_at_middle(p, top, limit);
                if (top < 0)
                    return false;
            }
        }
        return true;
    }
};
