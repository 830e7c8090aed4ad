// Offers of face pairs to the slots of their object pair on the CPU, 16 at a time.
#pragma once
#include "builtin.h"
#include "contacts/near_offer.cuh"
#include "distance/corners32.h"

template <class Trees, class PairPose>
void simd_offer_faces(const Trees& trees, const PairPose& pose, wp::int32 count, wp::array_t<wp::int64> faces,
                      wp::vec2 bounds, wp::array_t<wp::float32> directions, wp::vec2i widths, wp::int32 pair,
                      wp::array_t<wp::int64> slots) {
    typedef NearOffer O;
    const float scale = (float)pose.scale;
    wp::vec3 there;
    for (int i = 0; i < 3; ++i)
        there[i] = pose.translation32[i] * scale;
    wp::int64* const own = slots.data + (wp::int64)pair * SLOT_ROOM;
    for (int first = 0; first < count; first += 16) {
        const wp::int64* items = faces.data + first;
        const int some = count - first < 16 ? count - first : 16;
        const O::N::Corners corners = NearestCorners::load(trees, pose, there, scale, items, some);
        const O::Scores scores = O::rate(corners, bounds[0], bounds[1], directions.data);
        const SlotKeys<O::lanes, O::bits, O::F::integers> keys(scores, widths[0] + widths[1]);
        for (unsigned int left = O::F::to_mask(scores.counts) & ((1u << some) - 1); left != 0; left &= left - 1) {
            const int i = __builtin_ctz(left);
            int slot_count;
            wp::int64* const at = own + O::find_slots(scores.bin[i], scores.inside[i] != 0, slot_count);
            keys.put(at, i, slot_count, O::name_of(widths, (int)(items[i] >> 32), (int)items[i]));
        }
    }
}
