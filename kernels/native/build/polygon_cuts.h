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
        rows = 0;
        stack[0].count = 3;
        for (int k = 0; k < 3; ++k) {
            stack[0].corner[k] = Corner{corner[3 * k], corner[3 * k + 1], corner[3 * k + 2], nullptr};
            (*this)(stack[0].corner[k]);
        }
    }
    // What measures a new corner; false where there is no room for distances.
    bool operator()(Corner& x) {
        const int row = 8 * near.groups;
        if ((rows + 1) * row > DISTANCE_ROOM)
            return false;
        double* found = distance + row * rows++;
        near.measure(x, found);
        x.distance = found;
        return true;
    }
    // Split by the face nearest to the middle.
    int split_at_middle(Polygon& p, int top, double limit) {
        alignas(64) double row[NEAR_ROOM];
        double here;
        near.measure(p.middle(), row);
        const int over = near.nearest(row, here);
        Plane side[3];
        const int sides = near.group[over >> 3].find_sides(over & 7, side);
        return split_polygon(p, stack, top, side, sides, 0x1p-46 + 0.05 * wp::sqrt(limit), *this);
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
