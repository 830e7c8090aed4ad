// Linear CCD in double words: the time until which two faces stay apart whose corners move straight.
#pragma once
#include "builtin.h"
#include "exact/moving_faces.h"

inline CUDA_CALLABLE wp::vec_t<2, wp::float64> apart_until(wp::mat_t<6, 6, wp::float64> starts,
                                                           wp::mat_t<6, 6, wp::float64> ends,
                                                           wp::vec_t<3, wp::float64> away, wp::float64 error,
                                                           wp::float64 start, wp::float64 limit) {
    int reason;
    MovingFaces faces(starts.data, ends.data, error);
    // At time 0 nothing says that they are apart: they are if B's face comes there and meets nothing on that way.
    if (start == 0.0) {
        const double place_error = faces.place_error, way[3] = {away[0], away[1], away[2]};
        faces.away = way;
        faces.place_error = 32.0 * place_error;
        faces.apart_until(0.0, 1.0, reason);
        if (reason != 0)
            return {0.0, 1.0};
        faces.away = nullptr;
        faces.place_error = place_error;
    }
    const double until = faces.apart_until(start, limit, reason);
    return {until, wp::float64(reason)};
}
