// Offers of listed face pairs to the slots of their object pairs on the CPU, 16 at a time.
#pragma once
#include "builtin.h"
#include "contacts/near_offer.cuh"
#include "distance/corners32.h"

template <class ModelPool, class StatePool, class PairPose>
void simd_offer_list(const ModelPool& models, const StatePool& states, wp::array_t<PairPose> pair_poses,
                     wp::int32 count, wp::array_t<wp::vec_t<3, wp::int32>> list,
                     wp::array_t<wp::vec_t<2, wp::float32>> measures, wp::array_t<wp::float32> directions,
                     wp::array_t<wp::vec_t<2, wp::int32>> widths, wp::array_t<wp::int64> slots) {
    typedef NearOffer O;
    for (int first = 0, some; first < count; first += some) {
        const int pair = list.data[first][0];
        const PairPose& pose = pair_poses.data[pair];
        const float scale = (float)pose.scale;
        wp::vec_t<3, float> there;
        for (int i = 0; i < 3; ++i)
            there[i] = pose.translation32[i] * scale;
        wp::int64 items[16];
        for (some = 0; some < 16 && first + some < count && list.data[first + some][0] == pair; ++some)
            items[some] = ((wp::int64)list.data[first + some][1] << 32) | (unsigned int)list.data[first + some][2];
        const O::N::Corners corners =
            NearestCorners::load(models.vertex_near.data, states.face_corner.data, pose.corner_a, pose.corner_b,
                                 pose.rotation32.data, there, scale, items, some);
        const O::Scores scores = O::rate(corners, measures.data[pair][0], measures.data[pair][1], directions.data);
        wp::int64* const own = slots.data + (wp::int64)pair * SLOT_ROOM;
        for (int i = 0; i < some; ++i)
            O::put(scores, i, widths.data[pair], list.data[first + i][1], list.data[first + i][2], own);
    }
}
