"""Random and adversarial triangle pairs: functions of (rng, count), float64 (count, 2, 3, 3)."""

import numpy as np

CLEARED = 2.0**-290  # coordinates below are 0, as in the library


def generic(rng, count):
    """Triangles of all sizes near each other."""
    size = 2.0 ** rng.uniform(-3, 1, (count, 2, 1, 1))
    return rng.normal(size=(count, 2, 3, 3)) * size + 0.5 * rng.normal(size=(count, 2, 1, 3))


def lattice(rng, count):
    """Corners on a lattice of two to six points an axis: most pairs touch, are coplanar or have zero area."""
    return np.floor(rng.random((count, 2, 3, 3)) * rng.integers(2, 7, (count, 1, 1, 1)))


def in_plane(rng, u, v, origin):
    """Return triangles in the plane of two vectors and a point, (count, 1, 1, 3) each."""
    s, t = rng.integers(-3, 4, (2, len(u), 2, 3, 1)).astype(float)
    return u * s + v * t + origin


def coplanar(rng, count):
    """Both triangles in one oblique plane, exactly; some are segments and points."""
    return in_plane(rng, *rng.integers(-(2**9), 2**9, (3, count, 1, 1, 3)).astype(float))


def nearly_coplanar(rng, count):
    """The same, in a plane of real numbers, hence a rounding or two apart."""
    return in_plane(rng, *rng.normal(size=(3, count, 1, 1, 3)))


def touch(rng, a):
    """Return triangles with a corner, or more, on a corner, an edge or the inside of others (count, 3, 3)."""
    count = len(a)
    weight = rng.choice([0.0, 0.25, 0.5, 1.0, -0.5], (count, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    return (weight[:, :, :, None] * a[:, None]).sum(2)


def touching(rng, count):
    """The second triangle starts on the first, exactly, and some of it lies in the first's plane."""
    a = 4.0 * rng.integers(-(2**8), 2**8, (count, 3, 3))
    off = rng.integers(0, 2, (count, 3, 1)) * rng.integers(-64, 65, (count, 3, 3))
    off[:, 0] = 0
    return np.stack([a, touch(rng, a) + off], 1)


def nudge(rng, pairs):
    """Move coordinates by up to two units in the last place."""
    return pairs + rng.integers(-2, 3, pairs.shape) * np.spacing(np.abs(pairs))


def ulp_perturbed(rng, count):
    """The same on real coordinates, every coordinate moved by up to two units in the last place."""
    a = rng.normal(size=(count, 3, 3)) + 2.0 ** rng.integers(-3, 12, (count, 1, 1)) * rng.normal(size=(count, 1, 3))
    off = rng.integers(0, 2, (count, 3, 1)) * rng.normal(size=(count, 3, 3))
    off[:, 0] = 0
    return nudge(rng, np.stack([a, touch(rng, a) + off], 1))


def shared(rng, count):
    """One to three corners shared to the bit, in any place, on real coordinates."""
    pairs = rng.normal(size=(count, 2, 3, 3)) * 2.0 ** rng.integers(-20, 20, (count, 1, 1, 1))
    number = rng.integers(1, 4, count)
    for corner in range(3):
        pairs[number > corner, 1, corner] = pairs[number > corner, 0, corner]
    order = rng.permuted(np.tile(np.arange(3), (count, 1)), axis=1)
    pairs[:, 1] = np.take_along_axis(pairs[:, 1], order[:, :, None], 1)
    return pairs


def nearly_shared(rng, count):
    """The same with every coordinate moved by up to two units in the last place."""
    return nudge(rng, shared(rng, count))


def collinear(rng, count):
    """Segments and points along a line or two, some against whole triangles."""
    origin, way = rng.integers(-4, 5, (2, count, 2, 1, 3)).astype(float)
    one_line = rng.random(count) < 0.3
    origin[one_line, 1], way[one_line, 1] = origin[one_line, 0], way[one_line, 0]
    segment = origin + way * rng.integers(-3, 4, (count, 2, 3, 1))
    whole = rng.random((count, 2, 1, 1)) < 0.3
    return np.where(whole, rng.integers(-4, 5, (count, 2, 3, 3)), segment).astype(float)


def zero_area(rng, count):
    """A segment or point of real coordinates against a triangle that it starts on, or nearly so."""
    a = rng.normal(size=(count, 3, 3))
    b = touch(rng, a) + rng.choice([0.0, 2.0**-52, 1.0], (count, 1, 1)) * rng.normal(size=(count, 3, 3))
    b[:, 2] = b[:, 1]
    point = rng.random(count) < 0.2
    b[point, 1] = b[point, 2] = b[point, 0]
    return np.stack([a, b], 1)


def sliver(rng, count):
    """Triangles of aspect 1e12 that start on one another."""
    corner, far, side = rng.normal(size=(3, count, 3))
    middle = rng.random((count, 1))
    a = np.stack([corner, corner + far, corner + middle * far + 1e-12 * side], 1)
    start = touch(rng, a)[:, 0]
    far, side = rng.normal(size=(2, count, 3))
    b = np.stack([start, start + far, start + rng.random((count, 1)) * far + 1e-12 * side], 1)
    ends = rng.random(count) < 0.5
    b[ends] += 1e-12 * rng.normal(size=(int(ends.sum()), 1, 3))
    return np.stack([a, b], 1)


def extreme(rng, count):
    """Pairs of the kinds above at magnitudes from 2^-270 to 2^140, or coordinates of mixed magnitude."""
    pairs = np.concatenate([make(rng, -(-count // 4)) for make in (generic, touching, ulp_perturbed, lattice)])[:count]
    scale = np.where(rng.random((count, 1, 1, 1)) < 0.5, 0, rng.integers(-40, 41, pairs.shape))
    return clear_tiny(np.ldexp(pairs, scale + rng.integers(-240, 90, (count, 1, 1, 1))))


def clear_tiny(pairs):
    """Set tiny coordinates to 0, as the library does."""
    return np.where(np.abs(pairs) < CLEARED, 0.0, pairs)


TOUCHING = (lattice, coplanar, nearly_coplanar, touching, ulp_perturbed, shared, nearly_shared)
ADVERSARIAL = {make.__name__: make for make in (*TOUCHING, collinear, zero_area, sliver, extreme)}
KINDS = {"random": generic, **ADVERSARIAL}


def make_chunk(job):
    """Return the pairs of (kind, chunk number, count), the same to the bit whoever asks."""
    kind, number, count = job
    seed = [list(KINDS).index(kind), number]
    return clear_tiny(KINDS[kind](np.random.default_rng(seed), count))
