// On which sides of planes the corners of faces lie, on the CPU: of as many face pairs as a mask has bits.
#pragma once
#include "builtin.h"

// Of triangles those whose first corner is alone, whose second is, and whose lone corner lies on the negative side.
struct Alone {
    unsigned int first, second, back;
};

// Of signs those that are 1, -1 and neither for certain.
struct Sides {
    unsigned int above, below, open;

    // Of three corners.
    static unsigned int one_sided(const Sides (&s)[3]) {
        return (s[0].above & s[1].above & s[2].above) | (s[0].below & s[1].below & s[2].below);
    }
    static unsigned int has_sides(const Sides (&s)[3]) {
        return (s[0].above | s[0].below) & (s[1].above | s[1].below) & (s[2].above | s[2].below);
    }
    static unsigned int has_all_zero(const Sides (&s)[3]) {
        unsigned int any = 0;
        for (int i = 0; i < 3; ++i)
            any |= s[i].above | s[i].below | s[i].open;
        return ~any;
    }
    // As `find_alone`.
    static Alone find_alone(const Sides (&s)[3]) {
        const unsigned int pair_above = s[0].above & s[1].above, pair_below = s[0].below & s[1].below;
        const unsigned int odd_above = s[0].above ^ s[1].above, odd_below = s[0].below ^ s[1].below;
        const unsigned int positive = (odd_above ^ s[2].above) & ~(pair_above & s[2].above);
        const unsigned int negative = (odd_below ^ s[2].below) & ~(pair_below & s[2].below) & ~positive;
        const unsigned int zero = ~(positive | negative);
        auto is_kind = [&](const Sides& side) {
            return (positive & side.above) | (negative & side.below) | (zero & ~(side.above | side.below));
        };
        const unsigned int two_above = pair_above | (odd_above & s[2].above);
        return Alone{is_kind(s[0]), is_kind(s[1]), negative | (zero & two_above)};
    }
    // The same where none of the corners touches.
    static Alone find_lone(const Sides (&s)[3]) {
        const unsigned int odd = s[0].above ^ s[1].above, other = s[1].above ^ s[2].above;
        return Alone{odd & ~other, odd & other, (s[0].above & s[1].above) | (odd & s[2].above)};
    }
};
