"""Linear CCD of features in fractions: signs of polynomials at their roots tell whether they ever meet.

Four corners meet as a corner and a face, or as two edges, only while they lie in one plane: at a root of the cubic that
is their determinant, or at any time if that vanishes. There, signs of polynomials decide; a root is an interval that
holds no other, halved until what is asked has a sign in it, or a common divisor says that it is 0.
"""

import itertools
from fractions import Fraction

AXES = ((1, 2), (2, 0), (0, 1))


def trim(p):
    while p and p[-1] == 0:
        p = p[:-1]
    return p


def add(p, q):
    return trim([a + b for a, b in itertools.zip_longest(p, q, fillvalue=0)])


def scale(p, x):
    return trim([a * x for a in p])


def multiply(p, q):
    product = [0] * (len(p) + len(q) - 1) if p and q else []
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            product[i + j] += a * b
    return trim(product)


def remainder(p, q):
    while len(p) >= len(q):
        p = add(p, [0] * (len(p) - len(q)) + scale(q, -p[-1] / q[-1]))
    return p


def divisor(p, q):
    """Return the greatest common divisor, leading coefficient 1."""
    while q:
        p, q = q, remainder(p, q)
    return scale(p, 1 / p[-1])


def quotient(p, q):
    """Return p / q, which leaves no remainder."""
    found = [Fraction(0)] * (len(p) - len(q) + 1)
    while p:
        place = len(p) - len(q)
        found[place] = p[-1] / q[-1]
        p = add(p, [0] * place + scale(q, -found[place]))
    return found


def slope(p):
    return [i * a for i, a in enumerate(p)][1:]


def value(p, t):
    total = Fraction(0)
    for a in reversed(p):
        total = total * t + a
    return total


def sign(x):
    return (x > 0) - (x < 0)


def count_roots(p, low, high):
    """Return how many different roots lie in (low, high]. Source: Sturm."""
    chain = [p, slope(p)]
    while chain[-1]:
        chain.append(scale(remainder(chain[-2], chain[-1]), -1))

    def changes(t):
        signs = [s for s in (sign(value(q, t)) for q in chain) if s]
        return sum(a != b for a, b in itertools.pairwise(signs))

    return changes(low) - changes(high)


class Root:
    """The one root of a polynomial in (low, high), or the number low = high."""

    def __init__(self, p, low, high):
        self.p, self.low, self.high = p, low, high

    def halve(self):
        middle = (self.low + self.high) / 2
        if value(self.p, middle) == 0:
            self.low = self.high = middle
        elif sign(value(self.p, middle)) == sign(value(self.p, self.low)):
            self.low = middle
        else:
            self.high = middle

    def sign_of(self, q):
        """Return the sign of another polynomial here."""
        if not q:
            return 0
        if self.low < self.high:
            common = divisor(self.p, q)
            if len(common) > 1 and sign(value(common, self.low)) != sign(value(common, self.high)):
                return 0
        while self.low < self.high and (value(q, self.low) == 0 or count_roots(q, self.low, self.high)):
            self.halve()
        return sign(value(q, self.low))


def roots(p):
    """Return all roots in [0, 1], in order."""
    if len(p) < 2:
        return []
    p = quotient(p, divisor(p, slope(p))) if len(p) > 2 else p
    zero, one = Fraction(0), Fraction(1)
    found = [Root(p, zero, zero)] if value(p, zero) == 0 else []

    def split(low, high):
        count = count_roots(p, low, high)
        if count == 0:
            return
        if count == 1:
            if value(p, high) == 0:
                found.append(Root(p, high, high))
                return
            if value(p, low) != 0:
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
    u, v = ([add(b[i], scale(a[i], -1)) for i in range(3)] for a, b in ((p, q), (p, r)))
    return add(multiply(u[j], v[k]), scale(multiply(u[k], v[j]), -1))


class Motion:
    """Corners (4, 3) of a corner and a face, or of two edges, from first to last."""

    def __init__(self, first, last, edges):
        pairs = zip(first, last, strict=True)
        both = [[(Fraction(a), Fraction(b)) for a, b in zip(p, q)] for p, q in pairs]
        self.at = [[trim([a, b - a]) for a, b in corner] for corner in both]
        self.edges = edges

    def volume(self):
        a, *rest = self.at
        u, v, w = ([add(q[i], scale(a[i], -1)) for i in range(3)] for q in rest)
        total = []
        for i, (j, k) in enumerate(AXES):
            minor = add(multiply(v[j], w[k]), scale(multiply(v[k], w[j]), -1))
            total = add(total, multiply(u[i], minor))
        return total

    def forms(self):
        """Return all polynomials whose signs `meets_at` looks at."""
        triples = itertools.product(itertools.combinations(self.at, 3), range(3))
        differences = itertools.product(itertools.combinations(self.at, 2), range(3))
        return [turn(*points, axis) for points, axis in triples] + [
            add(q[axis], scale(p[axis], -1)) for (p, q), axis in differences
        ]

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
            x = {root.sign_of(add(q[axis], scale(p[axis], -1))) for p in one for q in other}
            if x in ({1}, {-1}):
                return False
        return True

    def meet(self):
        """Return whether features meet at some time in [0, 1]."""
        volume = self.volume()
        if volume:
            return any(self.meets_at(root) for root in roots(volume))
        # When they first meet, a sign changes.
        zero, one = Fraction(0), Fraction(1)
        times = [Root([], zero, zero), Root([], one, one)]
        for form in {tuple(form) for form in self.forms()}:
            times += roots(list(form))
        return any(self.meets_at(time) for time in times)
