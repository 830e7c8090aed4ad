// Linear CCD in double words: the time until which two faces stay apart whose corners move straight.
#pragma once
#include "builtin.h"
#include "exact/moving_faces.h"

template <class FirstContact>
CUDA_CALLABLE void apart_until(wp::mat_t<6, 6, wp::float64> starts, wp::mat_t<6, 6, wp::float64> ends, wp::vec3d away,
                               wp::float64 error, wp::float64 start, wp::float64 limit, FirstContact& contact) {
    MovingFaces faces(starts.data, ends.data, error);
    // At time 0 nothing says that they are apart: they are if B's face comes there and meets nothing on that way.
    if (start == 0.0) {
        const double place_error = faces.place_error, way[3] = {away[0], away[1], away[2]};
        faces.away = way;
        faces.place_error = 32.0 * place_error;
        faces.apart_until(0.0, 1.0, contact.end);
        if (contact.end != 0) {
            contact.time = 0.0;
            contact.end = 1;
            return;
        }
        faces.away = nullptr;
        faces.place_error = place_error;
    }
    contact.time = faces.apart_until(start, limit, contact.end);
}
