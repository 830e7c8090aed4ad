// Candidate points of contacts, corners of columns: offers of those of faces that cross to slots, of one contact in a
// thread, of 8 on the CPU; and of witnesses, written one by one.
#pragma once
#include "builtin.h"
#include "contacts/column.cuh"
#include "contacts/slots.cuh"

// More than any, in offers to slots.
constexpr float NO_DEPTH_SEPARATION = 0x1p60f;

// How the slots of an object pair see its contacts: from the centre of A's model, at unit size.
struct SlotView {
    wp::vec3d centre;
    double scale, sense;  // 1, or -1 where the pair names B first
    float weight;         // of directions
    const float* directions;
};

template <class Trees, class PairPose, class Slots>
CUDA_CALLABLE SlotView view_pair(const Trees& trees, const PairPose& pose, wp::int32 a, wp::int32 pair,
                                 const Slots& slots) {
    return {trees.models.centre.data[trees.states.model.data[trees.objects.state.data[a]]], pose.scale,
            pose.swapped != 0 ? -1.0 : 1.0, slots.weight.data[pair], slots.directions.data};
}

// Rates the candidates of contacts.
template <class Number>
struct CrossingRate {
    typedef Columns<Number> C;
    typedef typename C::Point Point;
    typedef typename C::lanes lanes;
    typedef typename C::bits bits;
    typedef SlotScores<typename Number::floats, typename Number::float_bits, typename Number::integers> Scores;
    typedef typename Scores::Vector Vector;
    const SlotView& view;
    bits has_depth;
    lanes least;
    Scores scores;

    static CUDA_CALLABLE Vector narrow(const lanes& x, const lanes& y, const lanes& z) {
        return Vector{Number::narrow(x), Number::narrow(y), Number::narrow(z)};
    }
    static CUDA_CALLABLE typename Number::integers find_bin(const SlotView& view, const Point& n) {
        return Scores::find_bin(narrow(view.sense * n.x, view.sense * n.y, view.sense * n.z), view.directions);
    }
    CUDA_CALLABLE CrossingRate(const SlotView& view, const typename C::Crossing& contact,
                               const typename C::Measured& best)
        : view(view),
          has_depth(best.depth > C::no_depth()),
          least(contact.least),
          scores(find_bin(view, best.normal), view.directions) {
        const lanes zero = {};
        if (Number::any(C::negate(has_depth)))  // behind whatever has a depth
            scores.offer(view.weight, narrow(zero, zero, zero), Number::narrow(zero) + NO_DEPTH_SEPARATION,
                         Number::narrow_bits(C::negate(has_depth)));
        if (Number::any(has_depth))
            typename C::Column(contact.faces, best.normal, contact.normal_a, contact.normal_b).visit(*this);
    }
    CUDA_CALLABLE void offer(const Point& point, const lanes& depth, const bits& exists) {
        const wp::vec3d& c = view.centre;
        const Vector x =
            narrow((point.x - c[0]) * view.scale, (point.y - c[1]) * view.scale, (point.z - c[2]) * view.scale);
        scores.offer(view.weight, x, Number::narrow(-depth * view.scale),
                     Number::narrow_bits(has_depth & exists & (depth >= least)));
    }
};

typedef Columns<Number64> OneColumn;

template <class Pair>
CUDA_CALLABLE OneColumn::Faces faces_of(const Pair& pair) {
    return {{point_of(pair.a0), point_of(pair.a1), point_of(pair.a2)},
            {point_of(pair.b0), point_of(pair.b1), point_of(pair.b2)}};
}

template <class Objects, class Pair>
CUDA_CALLABLE OneColumn::Crossing crossing_of(const Objects& objects, const Pair& pair, const wp::vec3d& loop,
                                              bool has_area, double gap) {
    return OneColumn::Crossing(faces_of(pair), objects.rotation.data[pair.object].data, point_of(pair.normal_a),
                               point_of(pair.normal_b), point_of(loop), has_area, gap);
}

template <class Trees, class PairPose, class Pair, class Slots>
CUDA_CALLABLE void offer_crossing(const Trees& trees, const PairPose& pose, const Pair& pair, wp::vec3d loop,
                                  bool has_area, wp::float64 gap, wp::int32 place, wp::int32 p, const Slots& slots) {
    const OneColumn::Crossing contact = crossing_of(trees.objects, pair, loop, has_area, gap);
    const OneColumn::Measured best = contact.measure();
    const SlotView view = view_pair(trees, pose, pair.object, p, slots);
    const CrossingRate<Number64> rated(view, contact, best);
    put_into_slots(slots.key.data + (wp::int64)p * SLOT_ROOM + SLOTS_A_BIN * (rated.scores.bin / 9), rated.scores.score,
                   SCORES, 32, place);
}

// Writes a normal and candidates of a witness, posed to the world: the corners of a column that are deep enough.
template <class Objects, class Witnesses>
struct CandidateWriter {
    typedef OneColumn C;
    const Objects& objects;
    const Witnesses& witnesses;
    wp::int32 a, w;
    double least;
    int place;

    CUDA_CALLABLE void write_normal(const C::Point& n) const {
        witnesses.normal.data[w] = vector_of(C::turn(objects.rotation.data[a].data, n));
    }
    CUDA_CALLABLE void write_corners(const C::Column& column) {
        column.visit(*this);
        for (; place < COLUMN_CORNERS; ++place)
            witnesses.depth.data[(wp::int64)COLUMN_CORNERS * w + place] = NAN;
    }
    CUDA_CALLABLE void offer(const C::Point& point, double depth, bool exists) {
        if (!exists || depth < least || place == COLUMN_CORNERS)
            return;
        const wp::int64 k = (wp::int64)COLUMN_CORNERS * w + place++;
        witnesses.depth.data[k] = depth;
        witnesses.point.data[k] = vector_of(C::pose(objects.rotation.data[a].data, objects.position.data[a], point));
    }
};

template <class Objects, class Pair, class Witnesses>
CUDA_CALLABLE bool find_crossing(const Objects& objects, const Pair& pair, wp::vec3d loop, bool has_area,
                                 wp::float64 gap, wp::int32 w, const Witnesses& witnesses) {
    typedef OneColumn C;
    const C::Crossing contact = crossing_of(objects, pair, loop, has_area, gap);
    const C::Measured best = contact.measure();
    CandidateWriter<Objects, Witnesses> writer = {objects, witnesses, pair.object, w, contact.least, 0};
    writer.write_normal(best.normal);
    const bool has_depth = best.depth > C::no_depth();
    if (has_depth)
        writer.write_corners(C::Column(contact.faces, best.normal, contact.normal_a, contact.normal_b));
    return has_depth;
}

template <class Objects, class Pair, class Witnesses>
CUDA_CALLABLE bool find_facing(const Objects& objects, const Pair& pair, wp::float64 gap, wp::float64 separation,
                               wp::int32 w, const Witnesses& witnesses) {
    typedef OneColumn C;
    const C::Faces faces = faces_of(pair);
    const auto& rotation = objects.rotation.data[pair.object].data;
    const C::Point normal_a = C::turn_back(rotation, point_of(pair.normal_a));
    const C::Point normal_b = C::turn_back(rotation, point_of(pair.normal_b));
    const double slack = C::greater(ALIKE * separation, C::find_slack(faces));
    C::Measured best = {normal_a, C::no_depth()};
    // A gap wider than the distance stays so whatever the other normal says.
#pragma unroll 1
    for (int k = 0; k < 2 && (best.depth == C::no_depth() || -best.depth - separation <= slack); ++k) {
        const C::Point n = C::choose(k == 0, normal_a, C::negate(normal_b));
        const C::Measured found = C::measure(faces, n, normal_a, normal_b, -gap);
        if (best.depth == C::no_depth() || (found.depth > C::no_depth() && found.depth < best.depth))
            best = found;
    }
    const bool serves = fabs(fabs(best.depth) - separation) <= slack;
    if (serves) {
        CandidateWriter<Objects, Witnesses> writer = {objects, witnesses, pair.object, w, -gap, 0};
        witnesses.nearest_only.data[w] = best.depth > slack;
        writer.write_normal(best.normal);
        writer.write_corners(C::Column(faces, best.normal, normal_a, normal_b));
    }
    return serves;
}
