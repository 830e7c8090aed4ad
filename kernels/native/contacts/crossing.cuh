// Contacts of faces that cross, and offers of their candidate points, corners of columns, to slots: of one contact in a
// thread, of 8 on the CPU.
#pragma once
#include "builtin.h"
#include "contacts/slots.cuh"
#include "triangle/column.cuh"

// A face's own normal serves in place of the loop's within 60 degrees of it.
constexpr double LIKENESS = 0.5;
// More than any, in offers to slots.
constexpr float NO_DEPTH_SEPARATION = 0x1p60f;

template <class Number>
struct Crossings : Columns<Number> {
    typedef Columns<Number> C;
    typedef typename C::lanes lanes;
    typedef typename C::bits bits;
    typedef typename C::Point Point;
    typedef typename C::Faces Faces;
    typedef typename C::Measured Measured;
    using C::choose, C::dot, C::greater, C::lesser, C::minus, C::negate;

    // A contact of faces that cross, in A's frame.
    struct Crossing {
        Faces faces;
        Point normal_a, normal_b, loop;  // unit normals of the faces, and of the contact's loop
        bits has_area;                   // whether that is the normal of an area
        lanes least;  // depth from which on there are candidates: 0, or minus the gap where faces look at one another
        double shallow;  // depth under which faces touch

        // Of normals in the world, turned into A's frame, of a gap, 0 for none, and of the scale to unit size.
        CUDA_CALLABLE Crossing(const Faces& faces, const double (&rotation)[3][3], const Point& world_a,
                               const Point& world_b, const Point& world_loop, const bits& has_area, double gap,
                               double scale)
            : faces(faces),
              normal_a(C::turn_back(rotation, world_a)),
              normal_b(C::turn_back(rotation, world_b)),
              loop(C::turn_back(rotation, world_loop)),
              has_area(has_area),
              shallow(NO_DISTANCE / scale) {
            least = -dot(world_a, world_b) >= LIKENESS ? lanes{} - gap : lanes{};
        }
        // Whether a face lies in front of the plane through u whose normal is n.
        static CUDA_CALLABLE bits lies_in_front(const Point& n, const Point& u, const Point (&v)[3],
                                                const lanes& slack) {
            const lanes x = dot(n, minus(v[0], u)), y = dot(n, minus(v[1], u)), z = dot(n, minus(v[2], u));
            return (lesser(x, lesser(y, z)) >= -slack) & (dot(n, n) > 0.0);
        }
        // Whether the second face lies in front of the first one, and the first in front of the second.
        CUDA_CALLABLE bits first_touches(const lanes& slack) const {
            return lies_in_front(normal_a, faces.a[0], faces.b, slack);
        }
        CUDA_CALLABLE bits second_touches(const lanes& slack) const {
            return lies_in_front(normal_b, faces.b[0], faces.a, slack);
        }
        // Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap
        // least; of both faces' normals where neither is like it and one looks the other way. Where faces merely touch,
        // the normal of a face that has the other in front serves, if it is like the loop's or that has no area, as
        // rounding may have made it; edges beside one another have none then. Where faces are hardly in one another, a
        // face's normal that rounding alone makes as good as the loop's serves only if the other face lies in front.
        // Depths of corners may lack as much as `Measured` says.
        CUDA_CALLABLE Measured measure() const {
            const lanes slack = C::find_slack(faces), toward_a = dot(loop, normal_a), toward_b = -dot(loop, normal_b);
            const bits opposed = -dot(normal_a, normal_b) >= LIKENESS, any_loop = negate(has_area) & opposed;
            const lanes like = has_area ? lanes{} + LIKENESS : lanes{} + FACING;
            const bits touches_a = first_touches(slack) & (any_loop | (toward_a > like));
            const bits touches_b = second_touches(slack) & (any_loop | (toward_b > like));
            const bits touches = touches_a | touches_b, none = touches_a & touches_b & negate(opposed);
            const bits first_a = touches_a & negate(touches_b & (toward_a < ALONG * toward_b));
            // A loop that runs all round a part in another, as round a thread, has no one way out.
            const lanes toward = greater(toward_a, toward_b);
            const bits contrary = (toward >= FACING) & (toward <= LIKENESS) & (lesser(toward_a, toward_b) < -FACING);
            // Of columns only normals and depths are kept: a second one beside the first does not fit into registers.
            Measured best = {loop, C::no_depth(), (touches & (least == 0.0)) ? slack : lanes{}};
#pragma unroll 1
            for (int k = 0; k < 3; ++k) {
                Point n = k == 1 ? normal_a : negate(normal_b);
                bits tried = negate(touches) & (contrary | (dot(n, loop) > LIKENESS)), tight = negate(bits{});
                if (k == 0) {
                    n = choose(touches, choose(first_a, normal_a, n), loop);
                    tried = negate(none);
                    tight = touches;
                }
                if (!Number::any(tried))
                    continue;
                const lanes depth =
                    C::measure(faces, n, normal_a, normal_b, tight ? lesser(least, -slack) : least).depth;
                // Rounding does not tell a face that the other one cuts from one that it touches.
                bits sure = best.depth >= shallow;
                if (k > 0 && Number::any(negate(sure)))
                    sure = sure | (k == 1 ? first_touches(lanes{} + shallow) : second_touches(lanes{} + shallow));
                const bits closer = (best.depth < -slack) | (depth <= best.depth + (sure ? slack : -slack));
                const bits better = k == 0 ? tried : tried & (depth >= -slack) & closer;
                best = Measured{choose(better, n, best.normal), better ? depth : best.depth, best.slack};
            }
            return best;
        }
    };
};

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
    typedef Crossings<Number> C;
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
          least(contact.least - best.slack),
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

typedef Crossings<Number64> OneCrossing;

template <class Pair>
CUDA_CALLABLE OneCrossing::Faces faces_of(const Pair& pair) {
    return {{point_of(pair.a0), point_of(pair.a1), point_of(pair.a2)},
            {point_of(pair.b0), point_of(pair.b1), point_of(pair.b2)}};
}

template <class Objects, class Pair>
CUDA_CALLABLE OneCrossing::Crossing crossing_of(const Objects& objects, const Pair& pair, const wp::vec3d& loop,
                                                bool has_area, double gap, double scale) {
    return OneCrossing::Crossing(faces_of(pair), objects.rotation.data[pair.object].data, point_of(pair.normal_a),
                                 point_of(pair.normal_b), point_of(loop), has_area, gap, scale);
}

template <class Trees, class PairPose, class Pair, class Slots>
CUDA_CALLABLE void offer_crossing(const Trees& trees, const PairPose& pose, const Pair& pair, wp::vec3d loop,
                                  bool has_area, wp::float64 gap, wp::int32 place, wp::int32 p, const Slots& slots) {
    const OneCrossing::Crossing contact = crossing_of(trees.objects, pair, loop, has_area, gap, pose.scale);
    const OneCrossing::Measured best = contact.measure();
    const SlotView view = view_pair(trees, pose, pair.object, p, slots);
    const CrossingRate<Number64> rated(view, contact, best);
    put_into_slots(slots.key.data + (wp::int64)p * SLOT_ROOM + SLOTS_A_BIN * (rated.scores.bin / 9), rated.scores.score,
                   SCORES, 32, place);
}
