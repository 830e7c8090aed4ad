// Offers of contacts of faces that cross to the slots of their object pair on the CPU, 8 at a time.
#pragma once
#include "builtin.h"
#include "contacts/contact64.h"
#include "contacts/crossing.cuh"

template <class Trees, class PairPose, class Contacts, class Curves, class Slots>
void simd_offer_crossing(const Trees& trees, const PairPose& pose, wp::int32 a, wp::float64 gap, wp::int32 pair,
                         wp::vec2i span, const Contacts& contacts, const Curves& curves, const Slots& slots) {
    typedef Crossings<Lanes64> C;
    const ContactFaces<PairPose> corners = {pose, contacts.face.data, (const double*)trees.models.vertex_pos.data,
                                            trees.states.face_corner.data};
    const SlotView view = view_pair(trees, pose, a, pair, slots);
    wp::int64* const own = slots.key.data + (wp::int64)pair * SLOT_ROOM;
    auto load = [](const wp::vec3d* vectors, int count) { return Contact64::load((const double*)vectors, count); };
    for (int first = span[0]; first < span[1]; first += 8) {
        const int count = span[1] - first < 8 ? span[1] - first : 8;
        int hit[8];
        wp::vec3d loop[8];
        C::bits has_area = {};
        for (int k = 0; k < count; ++k) {
            const int root = curves.loop.data[first + k];
            hit[k] = first + k;
            loop[k] = curves.loop_normal.data[root];
            has_area[k] = -(curves.has_area.data[root] != 0);
        }
        C::Faces f;
        if (pose.swapped != 0)
            corners.load(hit, count, f.b, f.a);
        else
            corners.load(hit, count, f.a, f.b);
        const C::Crossing contact(f, trees.objects.rotation.data[a].data, load(contacts.normal_a.data + first, count),
                                  load(contacts.normal_b.data + first, count), load(loop, count), has_area, gap,
                                  pose.scale);
        const CrossingRate<Lanes64> rated(view, contact, contact.measure());
        const SlotKeys<Lanes64::floats, Lanes64::float_bits, Lanes64::integers> keys(rated.scores, 32);
        for (int k = 0; k < count; ++k)
            keys.put(own + SLOTS_A_BIN * (rated.scores.bin[k] / 9), k, SCORES, first + k);
    }
}
