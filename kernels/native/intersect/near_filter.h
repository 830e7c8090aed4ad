// The filter of face pairs that are apart, on the CPU: 16 at a time in float32, those that may be nearer than a gap.
#pragma once
#include "builtin.h"
#include "distance/corners32.h"

template <class Trees, class PairPose>
wp::int32 simd_near_filter(const Trees& trees, const PairPose& pose, wp::int32 waiting, wp::array_t<wp::int64> faces) {
    typedef NearestFaces N;
    typedef N::F F;
    wp::int64* list = faces.data;
    const float scale = (float)pose.scale, gap = (float)(pose.within * pose.scale);
    // Beyond these numbers float32 has no squares, or no bounds.
    if (!(pose.error < 0x1p20f) || !(gap < 0x1p40f))
        return waiting;
    wp::vec3 there;
    for (int i = 0; i < 3; ++i)
        there[i] = pose.translation32[i] * scale;
    int kept = 0;
    for (int done = 0; done < waiting; done += 16) {
        const int count = waiting - done < 16 ? waiting - done : 16;
        const N::Corners corners = NearestCorners::load(trees, pose, there, scale, list + done, count);
        F::lanes size;
        const F::lanes d = __builtin_elementwise_sqrt(N::measure(corners, size));
        // Differences of corners err by `error` along an axis.
        const F::lanes under = d - N::error_of(d, size, 2.0f * pose.error);
        for (int i = 0; i < count; ++i) {
            list[kept] = list[done + i];
            kept += !(under[i] > gap * (1.0f + 0x1p-20f));
        }
    }
    return kept;
}
