"""Points whose determinants are sure, zero, or lost in rounding, and their signs in fractions.

Points are (count, dim + 1, dim), for 3 and for 2 dimensions.
"""

from fractions import Fraction

import numpy as np

COUNT = 400
TINY = 2.0**-290


def random_floats(rng, count, low, high):
    return np.ldexp(rng.uniform(1, 2, count) * rng.choice([-1.0, 1.0], count), rng.integers(low, high, count))


def lattice_points(rng, dim):
    return rng.integers(-3, 4, (COUNT, dim + 1, dim)).astype(float)


def coplanar_points(rng, dim, size=1.0):
    """The last point on the plane or line of the others, up to rounding and two units in the last place."""
    far = 2.0 ** rng.integers(-3, 20, (COUNT, 1, 1)) * rng.normal(size=(COUNT, 1, dim))
    points = rng.normal(size=(COUNT, dim + 1, dim)) + far
    weight = rng.choice([0.0, 0.25, 0.5, 1.0, -1.0, 0.3], (COUNT, dim - 1, 1))
    points[:, dim] = points[:, 0] + (weight * (points[:, 1:dim] - points[:, :1])).sum(1)
    points = size * (points + rng.integers(-2, 3, points.shape) * np.spacing(np.abs(points)))
    return np.where(np.abs(points) < TINY, 0.0, points)


def grid_points(rng, dim):
    """Coordinates of about 2^-290, a few multiples of 2^-342 apart: the products of three lie on the last bits."""
    return TINY * (1 + lattice_points(rng, dim) * 2.0**-52 + 4 * 2.0**-52)


def mixed_points(rng, dim):
    """Coordinates of every magnitude from 2^-290 to 1, repeated so that much cancels."""
    values = np.concatenate([random_floats(rng, 6, -290, 0), [0.0, TINY, 1.0]])
    return rng.choice(values, (COUNT, dim + 1, dim))


KINDS = {
    "random": lambda rng, dim: rng.normal(size=(COUNT, dim + 1, dim)),
    "lattice": lattice_points,
    "coplanar": coplanar_points,
    "tiny lattice": lambda rng, dim: lattice_points(rng, dim) * TINY,
    "tiny grid": grid_points,
    "tiny coplanar": lambda rng, dim: coplanar_points(rng, dim, 2.0**-285),
    "mixed": mixed_points,
    "large coplanar": lambda rng, dim: coplanar_points(rng, dim, 2.0**150),
    "large lattice": lambda rng, dim: lattice_points(rng, dim) * 2.0**150,
}


def true_terms(rows):
    """Return the products of a determinant as fractions, for points given as lists."""
    *rows, last = [[Fraction(x) for x in row] for row in rows]
    u = [[x - y for x, y in zip(row, last)] for row in rows]
    if len(u) == 2:
        return [u[0][0] * u[1][1], -u[0][1] * u[1][0]]
    terms = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        terms += [u[0][i] * u[1][j] * u[2][k], -u[0][i] * u[1][k] * u[2][j]]
    return terms


def true_signs(points):
    values = [sum(true_terms(rows)) for rows in points.tolist()]
    return np.array([(x > 0) - (x < 0) for x in values])


def rounded_signs(points):
    """Return the signs of determinants whose products and sums are rounded to float64."""
    u = points[:, :-1] - points[:, -1:]
    if points.shape[2] == 2:
        return np.sign(u[:, 0, 0] * u[:, 1, 1] - u[:, 0, 1] * u[:, 1, 0])
    u, v, w = u.transpose(1, 2, 0)
    x, y, z = v[1] * w[2] - v[2] * w[1], w[1] * u[2] - w[2] * u[1], u[1] * v[2] - u[2] * v[1]
    return np.sign((u[0] * x + v[0] * y) + w[0] * z)
