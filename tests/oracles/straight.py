"""Linear CCD of features in fractions: signs of polynomials at their roots tell whether they ever meet.

Four corners meet as a corner and a face, or as two edges, only while they lie in one plane: at a root of the cubic that
is their determinant, or at any time if that vanishes. There, signs of polynomials decide; a root is an interval that
holds no other, halved until what is asked has a sign in it, or a common divisor says that it is 0. Polynomials are
NumPy's, arrays of fractions.
"""

import itertools
from fractions import Fraction

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyder, polydiv, polymul, polysub, polyval

AXES = ((1, 2), (2, 0), (0, 1))


def divisor(p, q):
    """Return the greatest common divisor, leading coefficient 1."""
    while any(q):
        p, q = q, polydiv(p, q)[1]
    return p / p[-1]


def sign(x):
    return (x > 0) - (x < 0)


def count_roots(p, low, high):
    """Return how many different roots lie in (low, high]. Source: Sturm."""
    chain = [p, polyder(p)]
    while any(chain[-1]):
        chain.append(-polydiv(chain[-2], chain[-1])[1])

    def changes(t):
        signs = [s for s in (sign(polyval(t, q)) for q in chain) if s]
        return sum(a != b for a, b in itertools.pairwise(signs))

    return changes(low) - changes(high)


class Root:
    """The one root of a polynomial in (low, high), or the number low = high."""

    def __init__(self, p, low, high):
        self.p, self.low, self.high = p, low, high

    def halve(self):
        middle = (self.low + self.high) / 2
        if polyval(middle, self.p) == 0:
            self.low = self.high = middle
        elif sign(polyval(middle, self.p)) == sign(polyval(self.low, self.p)):
            self.low = middle
        else:
            self.high = middle

    def sign_of(self, q):
        """Return the sign of another polynomial here."""
        if not any(q):
            return 0
        if self.low < self.high:
            common = divisor(self.p, q)
            if len(common) > 1 and sign(polyval(self.low, common)) != sign(polyval(self.high, common)):
                return 0
        while self.low < self.high and (polyval(self.low, q) == 0 or count_roots(q, self.low, self.high)):
            self.halve()
        return sign(polyval(self.low, q))


def roots(p):
    """Return all roots in [0, 1], in order."""
    if len(p) < 2:
        return []
    p = polydiv(p, divisor(p, polyder(p)))[0] if len(p) > 2 else p
    zero, one = Fraction(0), Fraction(1)
    found = [Root(p, zero, zero)] if polyval(zero, p) == 0 else []

    def split(low, high):
        count = count_roots(p, low, high)
        if count == 0:
            return
        if count == 1:
            if polyval(high, p) == 0:
                found.append(Root(p, high, high))
                return
            if polyval(low, p) != 0:
                found.append(Root(p, low, high))
                return
        middle = (low + high) / 2
        split(low, middle)
        split(middle, high)

    split(zero, one)
    return found


def turn(p, q, r, axis):
    """Return on which side of p q the third point lies, seen along an axis."""
    j, k = AXES[axis]
    u, v = ([polysub(b[i], a[i]) for i in range(3)] for a, b in ((p, q), (p, r)))
    return polysub(polymul(u[j], v[k]), polymul(u[k], v[j]))


class Motion:
    """Corners (4, 3) of a corner and a face, or of two edges, from first to last."""

    def __init__(self, first, last, edges):
        pairs = zip(first, last, strict=True)
        both = [[(Fraction(a), Fraction(b)) for a, b in zip(p, q)] for p, q in pairs]
        self.at = [[np.array([a, b - a]) for a, b in corner] for corner in both]
        self.edges = edges

    def volume(self):
        a, *rest = self.at
        u, v, w = ([polysub(q[i], a[i]) for i in range(3)] for q in rest)
        total = np.array([Fraction(0)])
        for i, (j, k) in enumerate(AXES):
            minor = polysub(polymul(v[j], w[k]), polymul(v[k], w[j]))
            total = polyadd(total, polymul(u[i], minor))
        return total

    def forms(self):
        """Return all polynomials whose signs `meets_at` looks at."""
        triples = itertools.product(itertools.combinations(self.at, 3), range(3))
        differences = itertools.product(itertools.combinations(self.at, 2), range(3))
        found = [turn(*points, axis) for points, axis in triples]
        return found + [polysub(q[axis], p[axis]) for (p, q), axis in differences]

    def meets_at(self, root):
        """Return whether features in one plane meet."""
        a, b, c, d = self.at
        for axis in range(3):
            x = [root.sign_of(turn(*points, axis)) for points in ((b, c, d), (a, c, d), (a, b, d), (a, b, c))]
            if any(x):
                if self.edges:
                    return x[2] * x[3] <= 0 and x[0] * x[1] <= 0
                return x[0] != 0 and all(y * x[0] >= 0 for y in (x[1], -x[2], x[3]))
        one, other = ((a, b), (c, d)) if self.edges else ((a,), (b, c, d))
        for axis in range(3):
            x = {root.sign_of(polysub(q[axis], p[axis])) for p in one for q in other}
            if x in ({1}, {-1}):
                return False
        return True

    def meet(self):
        """Return whether features meet at some time in [0, 1]."""
        volume = self.volume()
        if any(volume):
            return any(self.meets_at(root) for root in roots(volume))
        # When they first meet, a sign changes.
        zero, one = Fraction(0), Fraction(1)
        times = [Root(None, zero, zero), Root(None, one, one)]
        for form in {tuple(form) for form in self.forms()}:
            times += roots(np.array(form))
        return any(self.meets_at(time) for time in times)
