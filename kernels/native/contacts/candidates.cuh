// Candidate points of witnesses, written one by one: of faces that cross, and of those that look at one another.
#pragma once
#include "builtin.h"
#include "contacts/crossing.cuh"

// Part of the distance that the gap along a face's normal differs by, where that is the direction of the distance.
constexpr double ALIKE = 0x1p-10;

// Writes a normal and candidates of a witness, posed to the world: the corners of a column that are deep enough.
template <class Objects, class Witnesses>
struct CandidateWriter {
    typedef OneCrossing C;
    const Objects& objects;
    const Witnesses& witnesses;
    wp::int32 a, w;
    double least, slack;     // depth of the least deep corner; one that lacks no more than `slack` counts as so deep
    double most = INFINITY;  // depth that none exceeds
    int place = 0;

    CUDA_CALLABLE void write_normal(const C::Point& n) const {
        witnesses.normal.data[w] = vector_of(C::turn(objects.rotation.data[a].data, n));
    }
    CUDA_CALLABLE void write_corners(const C::Column& column) {
        column.visit(*this);
        for (int k = place; k < COLUMN_CORNERS; ++k)
            witnesses.depth.data[(wp::int64)COLUMN_CORNERS * w + k] = NAN;
    }
    CUDA_CALLABLE void offer(const C::Point& point, double depth, bool exists) {
        if (!exists || depth < least - slack || place == COLUMN_CORNERS)
            return;
        const wp::int64 k = (wp::int64)COLUMN_CORNERS * w + place++;
        witnesses.depth.data[k] = C::lesser(C::greater(depth, least), most);
        witnesses.point.data[k] = vector_of(C::pose(objects.rotation.data[a].data, objects.position.data[a], point));
    }
};

template <class Objects, class Pair, class Witnesses>
CUDA_CALLABLE bool find_crossing(const Objects& objects, const Pair& pair, wp::vec3d loop, bool has_area,
                                 wp::float64 gap, wp::float64 scale, wp::int32 w, const Witnesses& witnesses) {
    typedef OneCrossing C;
    const C::Crossing contact = crossing_of(objects, pair, loop, has_area, gap, scale);
    const C::Measured best = contact.measure();
    CandidateWriter<Objects, Witnesses> writer = {objects, witnesses, pair.object, w, contact.least, best.slack};
    writer.write_normal(best.normal);
    const bool has_depth = best.depth > C::no_depth();
    if (has_depth)
        writer.write_corners(C::Column(contact.faces, best.normal, contact.normal_a, contact.normal_b));
    return has_depth;
}

template <class Objects, class Pair>
CUDA_CALLABLE wp::int32 touching_faces(const Objects& objects, const Pair& pair, wp::float64 scale) {
    const OneCrossing::Crossing faces = crossing_of(objects, pair, pair.normal_a, false, 0.0, scale);
    return (faces.first_touches(faces.shallow) ? 1 : 0) + (faces.second_touches(faces.shallow) ? 2 : 0);
}

template <class Objects, class Pair, class Witnesses>
CUDA_CALLABLE wp::int32 find_facing(const Objects& objects, const Pair& pair, wp::float64 gap, wp::float64 separation,
                                    wp::int32 side, wp::int32 w, const Witnesses& witnesses) {
    typedef OneCrossing C;
    const C::Faces faces = faces_of(pair);
    const auto& rotation = objects.rotation.data[pair.object].data;
    const C::Point normal_a = C::turn_back(rotation, point_of(pair.normal_a));
    const C::Point normal_b = C::turn_back(rotation, point_of(pair.normal_b));
    const double slack = C::greater(ALIKE * separation, C::find_slack(faces));
    C::Measured best = {normal_a, C::no_depth(), 0.0};
    // A gap wider than the distance stays so whatever the other normal says.
#pragma unroll 1
    for (int k = side == 2; k < 2 && (best.depth == C::no_depth() || -best.depth - separation <= slack); ++k) {
        if (k == 1 && side == 1)
            break;
        const C::Point n = C::choose(k == 0, normal_a, C::negate(normal_b));
        const C::Measured found = C::measure(faces, n, normal_a, normal_b, -gap);
        if (best.depth == C::no_depth() || (found.depth > C::no_depth() && found.depth < best.depth))
            best = found;
    }
    const bool serves = fabs(fabs(best.depth) - separation) <= slack;
    if (serves) {
        CandidateWriter<Objects, Witnesses> writer = {objects, witnesses, pair.object, w, -gap, 0.0};
        writer.write_normal(best.normal);
        writer.write_corners(C::Column(faces, best.normal, normal_a, normal_b));
    }
    return serves ? (best.depth > slack ? 2 : 1) : 0;
}

template <class Objects, class Pair, class Witnesses>
CUDA_CALLABLE bool find_along_edges(const Objects& objects, const Pair& pair, wp::vec3d way, wp::float64 separation,
                                    wp::int32 w, const Witnesses& witnesses) {
    typedef OneCrossing C;
    const C::Faces faces = faces_of(pair);
    const auto& rotation = objects.rotation.data[pair.object].data;
    const C::Column column(faces, C::turn_back(rotation, point_of(way)),
                           C::turn_back(rotation, point_of(pair.normal_a)),
                           C::turn_back(rotation, point_of(pair.normal_b)));
    const double rounding = C::find_slack(faces), least = -separation - C::greater(ALIKE * separation, rounding);
    CandidateWriter<Objects, Witnesses> writer = {objects, witnesses, pair.object, w, least, 0.0, -separation};
    if (!column.looks)
        return false;
    writer.write_corners(column);
    const wp::vec3d* const found = witnesses.point.data + (wp::int64)COLUMN_CORNERS * w;
    bool shared = false;
    for (int k = 1; k < writer.place; ++k)
        shared |= wp::length(found[k] - found[0]) > rounding * (ALIKE / COLUMN_ROUNDING);
    return shared;
}
