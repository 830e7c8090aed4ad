"""The certified error of a LOD to its last bit: distances in fractions, and covers on fewer faces than they want."""

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.samples import grid
from oracles.distance import brute_distances, exact_distance_sq, lattice_points

from warp_abtree.model import lod_bounds
from warp_abtree.model.progressive import build_progressive


def bumpy_sheet(size, height, seed):
    """A grid of squares with bumps."""
    vertices, faces = grid(size)
    vertices += np.random.default_rng(seed).uniform(-height, height, vertices.shape)
    return SimpleNamespace(vertices=vertices, faces=faces.astype(np.int32))


def test_no_vertex_lies_beyond_the_error():
    """The vertex that decides the error is measured with roundings, and would lie beyond it by some of them."""
    close = 0
    for seed in range(6):
        progressive = build_progressive(bumpy_sheet(2, 0.3, seed), base_faces=1)
        original = [[Fraction(x) for x in p] for p in progressive.vertex_pos[: progressive.vertex_count].tolist()]
        for lod in range(progressive.lod_max):
            vertices, faces, _ = progressive.mesh_at(lod)
            farthest = max(exact_distance_sq(p, vertices[faces]) for p in original)
            bound = Fraction(float(progressive.lod_error[lod])) ** 2
            assert farthest <= bound
            close += farthest > bound * (1 - Fraction(2) ** -36)
    assert close > 10, "elsewhere no vertex decides the error"


@pytest.mark.parametrize("slots", [0, 1, 8, 40])
def test_covers_on_fewer_faces_than_they_want_are_measured_again(slots, monkeypatch):
    """Polygons that find no slot stand on a face that is used already, perhaps a far one, and the bound must say so."""
    mesh, looser = bumpy_sheet(8, 0.3, 1), 0
    plenty = build_progressive(mesh, base_faces=1, certify=True)
    monkeypatch.setattr(lod_bounds, "SLOTS_PER_FACE", 0)
    monkeypatch.setattr(lod_bounds, "SLOTS_EXTRA", slots)
    progressive = build_progressive(mesh, base_faces=1)
    points = lattice_points(plenty.vertex_pos[mesh.faces], 4)
    for lod in range(0, progressive.lod_max, 5):
        vertices, faces, _ = progressive.mesh_at(lod)
        assert brute_distances(points, vertices[faces]).max() <= progressive.lod_error[lod] + 1e-13
        looser += progressive.lod_error[lod] > plenty.lod_error[lod]
    assert looser > 0, "there is no want of slots here"
