// Lists of face pairs that the float64 filter has decided, each with room for 8 more.
#pragma once
#include "builtin.h"
#include "base/float32.h"
#include "base/float64.h"

// Those that meet, those that are still open and, unless null, those that are apart; and how long the lists are.
struct FilterLists {
    typedef Float64 F;
    wp::int64 *hits, *rest, *beside;
    int met, open, apart;

    void keep_apart(const F::bits& item, unsigned int which) {
        if (beside == nullptr)
            return;
        Float32::append(beside + apart, item, which);
        apart += __builtin_popcount(which);
    }
    void keep_hits(const F::bits& item, unsigned int which) {
        Float32::append(hits + met, item, which);
        met += __builtin_popcount(which);
    }
    void keep_open(const F::bits& item, unsigned int which) {
        Float32::append(rest + open, item, which);
        open += __builtin_popcount(which);
    }
};
