// The distance of a point to one face, and the current polygon cut by the prism over one.
#pragma once
#include "builtin.h"
#include "build/faces64.h"

template <class Faces>
OneFace load_face(const Faces& face_pos, int f) {
    const double* x = (const double*)face_pos.data + 9 * (wp::int64)f;
    OneFace face;
    face.load({x[0], x[1], x[2]}, {x[3], x[4], x[5]}, {x[6], x[7], x[8]});
    return face;
}

template <class Faces>
__attribute__((noinline)) wp::float64 face_distance_sq(const Faces& face_pos, wp::int32 f, wp::vec3d p) {
    return load_face(face_pos, f).distance_sq(point_of(p));
}

struct NotMeasured {
    bool operator()(Corner&) const { return true; }
};

template <class Faces, class Scratch>
wp::int32 split_polygon(const Faces& face_pos, const Scratch& scratch, wp::int32 count, wp::int32 top, wp::int32 f,
                        wp::float64 margin) {
    Polygon p, part[4];
    const double* from = (const double*)scratch.polygon.data;
    for (p.count = 0; p.count < count; ++p.count, from += 3)
        p.corner[p.count] = Corner{from[0], from[1], from[2], nullptr};
    Plane side[3];
    const int sides = load_face(face_pos, f).find_sides(0, side);
    NotMeasured measure;
    const int parts = split_polygon(p, part, 0, side, sides, margin, measure);
    for (int i = 0; i < parts; ++i, ++top) {
        double* to = (double*)scratch.stack.data + 3 * POLYGON_CORNERS * top;
        scratch.stack_count.data[top] = part[i].count;
        for (int k = 0; k < part[i].count; ++k, to += 3) {
            to[0] = part[i].corner[k].x;
            to[1] = part[i].corner[k].y;
            to[2] = part[i].corner[k].z;
        }
    }
    return top;
}
