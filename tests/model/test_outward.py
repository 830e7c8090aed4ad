"""The outward error of a LOD, the distance of its surface from the original, against points of that surface."""

import pickle
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from conftest import real_mesh_path, slow
from helpers import refused
from helpers.samples import corners_of, crumbs, grid, line, of_trimesh, sample, soup
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles.distance import brute_distances, exact_distance_sq, farthest_distance, lattice_points

import warp_abtree as ab
from warp_abtree.model.lod_bounds import OutwardError

FUZZ = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])


def square_comb(teeth):
    """A flat comb: a strip 0.25 high, and on it teeth 0.75 high and 1 wide with gaps 0.5 wide."""
    place, faces = {}, []
    x = np.cumsum([0] + [1.0, 0.5] * teeth)
    for k in range(2 * teeth - 1):
        for low, high in ((0, 0.25), (0.25, 1))[: 2 - k % 2]:
            corner = [(x[k], low, 0.0), (x[k + 1], low, 0.0), (x[k + 1], high, 0.0), (x[k], high, 0.0)]
            a, b, c, d = (place.setdefault(p, len(place)) for p in corner)
            faces += [[a, b, c], [a, c, d]]
    return np.array(list(place)), np.array(faces)


def turned(vertices, faces, seed=0):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return vertices @ turn.T, faces


@st.composite
def models(draw):
    """Soups with repeated and degenerate faces, crumbs, flat grids and balls, out of shape and far from the origin."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    kinds = [
        (lambda count: soup(count, seed), 60),
        (lambda count: soup(count, seed, lattice=2 + count % 3), 60),
        (lambda count: crumbs(count, seed), 15),
        (grid, 6),
        (lambda _: of_trimesh(trimesh.creation.icosphere(1)), 1),
        (square_comb, 5),
    ]
    make, largest = draw(st.sampled_from(kinds))
    vertices, faces = make(draw(st.integers(1, largest)))
    if draw(st.booleans()):
        vertices = vertices + draw(st.sampled_from([1e-12, 1e-3, 0.3])) * rng.normal(size=vertices.shape)
    if draw(st.booleans()):
        vertices = turned(vertices * [1, 1, draw(st.sampled_from([1e-6, 0.1, 30.0]))], faces, seed)[0]
    vertices = vertices + draw(st.sampled_from([0.0, 0.0, 1e3, 1e9]))
    return ab.Model.from_arrays(vertices, faces, base_faces=draw(st.integers(1, 10)))


@FUZZ
@given(models(), st.floats(0, 1))
def test_no_point_is_farther(model, share):
    lod = int(share * model.lod_max)
    centre = corners_of(model)[0, 0]  # differences from it are exact or nearly so
    corners, points = corners_of(model) - centre, lattice_points(corners_of(model, lod) - centre, 9)
    bound = model.error_at(lod, side="outward") + 1e-15 * np.abs(points).max()  # points are rounded
    distance = brute_distances(points, corners)
    # Float64 cannot tell whether a point lies in a sliver; fractions can.
    for k in np.argsort(distance)[-3:]:
        if distance[k] > bound:
            assert exact_distance_sq([Fraction(x) for x in points[k].tolist()], corners) <= Fraction(bound) ** 2


EXACT = {
    "flat grid": lambda: turned(*grid(2), seed=1),
    "turned line": lambda: line(np.random.default_rng(9).normal(size=3), 6),
    "box": lambda: turned(*of_trimesh(trimesh.creation.box())),
    "lattice soup": lambda: soup(20, 6, lattice=3),
    "far away": lambda: (turned(*grid(2))[0] + 1e6 * np.random.default_rng(0).normal(size=3), grid(2)[1]),
}


@pytest.mark.parametrize("name", EXACT)
def test_rounding_is_covered(name):
    """Distances in fractions of points that are themselves fractions: the bound holds without any allowance."""
    model = ab.Model.from_arrays(*EXACT[name](), base_faces=1)
    weights = [(4, 0, 0), (0, 4, 0), (0, 0, 4), (2, 1, 1), (2, 2, 0), (0, 1, 3)]
    corners = corners_of(model)
    m = model.lod_max
    for lod in sorted({*np.geomspace(1, m + 1, 3).astype(int) - 1, *np.linspace(0, m, 3).astype(int)}):
        bound_sq = Fraction(model.error_at(lod, side="outward")) ** 2
        for triangle in corners_of(model, lod).tolist():
            for weight in weights:
                point = [sum(Fraction(w, 4) * Fraction(x) for w, x in zip(weight, axis)) for axis in zip(*triangle)]
                assert exact_distance_sq(point, corners) <= bound_sq


SHAPES = {
    "torus": lambda: of_trimesh(trimesh.creation.torus(1.0, 0.4, 24, 12)),
    "capsule": lambda: of_trimesh(trimesh.creation.capsule(1.0, 0.4, count=(16, 16))),
    "comb": lambda: turned(*square_comb(6)),
    "soup": lambda: soup(40, 7),
    "crumbs": lambda: crumbs(20),
}


@pytest.mark.parametrize("name", [*SHAPES, *slow("cow", "fandisk")])
def test_it_is_tight(name):
    known = name in SHAPES
    model = ab.Model.from_arrays(*SHAPES[name](), base_faces=4) if known else ab.Model.load(real_mesh_path(name))
    size = np.ptp(corners_of(model), axis=(0, 1)).max()
    for fraction in (0.5, 0.2, 0.05) if known else (0.1, 0.01):
        lod = model.lod_for(fraction=fraction)
        measured = farthest_distance(corners_of(model, lod), corners_of(model))
        assert measured - 1e-15 * size <= model.error_at(lod, side="outward") <= 1.03 * measured + 1e-12 * size


def test_sides_are_two_and_what_is_computed_is_kept(monkeypatch):
    """Inward is the default; outward is computed once and not pickled."""
    model = sample("ball")
    assert model.error_at(3) == model.error_at(3, side="inward") == model.progressive.lod_error[3]
    for side in ("Outward", None, ["outward"]):
        caught = refused(ValueError, "'inward' nor 'outward'", model.error_at, 3, side=side)
        assert repr(side) in str(caught)
    computed = []
    find = OutwardError._bound
    monkeypatch.setattr(OutwardError, "_bound", lambda self, lod: computed.append(lod) or find(self, lod))
    model = ab.Model.from_arrays(*SHAPES["torus"]())
    first = [model.error_at(lod, side="outward") for lod in (5, 9, 5, np.int64(9))]
    assert computed == [5, 9] and first[:2] == first[2:]
    again = pickle.loads(pickle.dumps(model))
    assert again.error_at(5, side="outward") == first[0] and computed == [5, 9, 5]
