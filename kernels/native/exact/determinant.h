// Determinants rounded once: sums of products in integers as long as it takes, made word by word, so that no array
// holds them.
#pragma once
#include "builtin.h"
#include "exact/wide_integer.h"
#include "exact/word_sum.h"

inline CUDA_CALLABLE wp::float64 exact_volume(wp::vec_t<3, wp::float64> a, wp::vec_t<3, wp::float64> b,
                                              wp::vec_t<3, wp::float64> c, wp::vec_t<3, wp::float64> d) {
#include "exact/wide_integer.h"
#include "exact/word_sum.h"
    typedef WideInteger Wide;
    // High and low word of each difference: six products of three, each of eight combinations.
    double part[3][3][2];
    int lowest = 0, highest = 0;
    for (int i = 0; i < 3; ++i) {
        int low = 1 << 20, high = 0;
        for (int j = 0; j < 3; ++j) {
            const double x = i == 0 ? a[j] : i == 1 ? b[j] : c[j];
            const double sum = x - d[j], taken = sum - x;
            part[i][j][0] = sum;
            part[i][j][1] = (x - (sum - taken)) - (d[j] + taken);
            for (int k = 0; k < 2; ++k) {
                const int exponent = Wide::exponent_of(part[i][j][k]);
                low = Wide::lower(low, Wide::lowest_bit(part[i][j][k]));
                high = exponent > high ? exponent : high;
            }
        }
        if (low == 1 << 20)
            return 0.0;  // a row of zeros
        lowest += low;
        highest += high + 1;
    }
    // Products are below 2^(highest + 159), and there are 48.
    const int length = highest + 159 + 6 - lowest;
    WordSum sum;
    for (int start = 0; start < length; start += 64) {
        for (int term = 0; term < 48; ++term) {
            const int i = term >> 4, odd = (term >> 3) & 1, j = (i + 1 + odd) % 3, k = (i + 2 - odd) % 3;
            const double x = part[0][i][term & 1], y = part[1][j][(term >> 1) & 1], z = part[2][k][(term >> 2) & 1];
            const bool negative = ((x < 0.0) != (y < 0.0)) != ((z < 0.0) != (odd != 0));
            sum.add(Wide::product_word(x, y, z, lowest + start), negative);
        }
        sum.end_word(start);
    }
    return sum.round(lowest - 3 * 1075);
}
