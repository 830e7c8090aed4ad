"""Models keep their bits: digests that were recorded once, by any number of threads, and on either path of the bounds.

The meshes have coordinates of few bits, and a build adds, multiplies, divides and takes square roots alone: the digests
are the same on every machine.
"""

import numpy as np
import pytest
from conftest import real_mesh_path

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.build.triangle_cover import COVERS_AT_ONCE, SLOTS
from warp_abtree.model import lod_bounds


def height_field(side, height):
    """A grid of side^2 squares whose heights are whole numbers over 64: the same bits on every machine."""
    x, y = np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij")
    corner = x[:-1, :-1] * (side + 1) + y[:-1, :-1]
    faces = np.concatenate(
        [
            np.stack([corner, corner + side + 1, corner + side + 2], -1).reshape(-1, 3),
            np.stack([corner, corner + side + 2, corner + 1], -1).reshape(-1, 3),
        ]
    )
    return np.stack([x, y, height(x, y) / 64], -1).reshape(-1, 3), faces


def waves(side):
    """Hills of cubic profile and some roughness."""
    return height_field(
        side, lambda x, y: (x % 16) * (16 - x % 16) * 2 + (y % 24) * (24 - y % 24) + (x * x * 7 + y * 13) % 5
    )


def bent_tube(around, along):
    """A closed tube of square section with rough sides."""
    i, j = np.meshgrid(np.arange(around), np.arange(along), indexing="ij")
    quarter, step = i * 4 // around, i * 4 % around
    x = np.choose(quarter, [step, around + 0 * step, around - step, 0 * step])
    y = np.choose(quarter, [0 * step, step, around + 0 * step, around - step])
    z = 16 * j + (i * i + 3 * j * j) % 7
    next_i, next_j = (i + 1) % around, j[:, :-1] + 1
    a, b = i * along + j, next_i * along + j
    a, b, c, d = a[:, :-1], b[:, :-1], (next_i * along)[:, :-1] + next_j, (i * along)[:, :-1] + next_j
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([x * 16 + j * j % 11, y * 16, z], -1).reshape(-1, 3) / 64, faces


def crowd(count):
    """Tetrahedra of many sizes, some of them apart, and a fan of many faces about one vertex."""
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    face = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    k = np.arange(count)
    place = np.stack([k * 37 % 61, k * 53 % 67, k * 29 % 71], -1) / 8
    vertices = (corner[None] * (1 + k % 5)[:, None, None] / 4 + place[:, None]).reshape(-1, 3)
    rim = np.arange(96)
    round_ = np.stack([rim * 8 % 96, np.abs(rim - 48), rim % 3], -1) / 16
    hub = 4 * count + 96
    fan = np.stack([np.full(96, hub), 4 * count + rim, 4 * count + (rim + 1) % 96], -1)
    return np.concatenate([vertices, round_, [[3.0, 1.0, 2.0]]]), np.concatenate(
        [(face[None] + 4 * k[:, None, None]).reshape(-1, 3), fan]
    )


def tangle(vertex_count, face_count):
    """Faces between random places of a coarse lattice: merges far apart cover the same triangles."""
    rng = np.random.default_rng(1)
    faces = rng.integers(0, vertex_count, (face_count, 3))
    return rng.integers(0, 64, (vertex_count, 3)) / 64, faces


MESHES = {
    "waves": lambda: waves(48),
    "flat": lambda: height_field(24, lambda x, y: 0 * x),
    "tube": lambda: bent_tube(32, 40),
    "crowd": lambda: crowd(60),
}
DIGESTS = {
    "waves": "1c52f25c98c57e2ca8c36a15f84a2025b93f0169463be62182e7ed8cca5cd265",
    "flat": "01fb648983cb8f63f9f962b2aa8e6330114f738e8146cd108bf529e4089134c0",
    "tube": "1c0e377ae33f95396c85cafbabac544040ad8599542afdeacd397a723258b5b9",
    "crowd": "e3c3c4aabe7a8e5b3be3829dbea292f12eb72424d3cf3a7745ceb010a8147280",
    "cow": "256eef31a0614cb1",
    "fandisk": "52315ff5f2f51de1",
    "homer": "ff5db907db0ed8c2",
    "stanford-bunny": "1b7f88d4b6470ec2",
}


@pytest.mark.parametrize("certify", [False, True], ids=["later", "beside"])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", MESHES)
def test_a_model_keeps_its_digest(name, threads, certify):
    with testing.regime(cpu_threads=threads):
        assert ab.Model.from_arrays(*MESHES[name](), base_faces=4, certify=certify).digest == DIGESTS[name]


@pytest.mark.parametrize("mesh", [waves(16), bent_tube(16, 12), crowd(30)], ids=["waves", "tube", "crowd"])
def test_covers_of_one_face_at_a_time_give_the_same(mesh, monkeypatch):
    """Where slots may run out, triangles are covered face by face: the same arithmetic without vectors."""
    first = ab.Model.from_arrays(*mesh, base_faces=4, certify=True)
    monkeypatch.setattr(lod_bounds, "SLOTS_PER_FACE", 0)
    monkeypatch.setattr(lod_bounds, "SLOTS_EXTRA", int(COVERS_AT_ONCE * SLOTS) - 1)
    assert ab.Model.from_arrays(*mesh, base_faces=4).digest == first.digest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cow", "fandisk", "homer", "stanford-bunny"])
@pytest.mark.parametrize("threads, certify", [(2, True), (2, False)])
def test_a_real_model_keeps_its_digest(name, threads, certify):
    with testing.regime(cpu_threads=threads):
        assert ab.Model.load(real_mesh_path(name), certify=certify).digest.startswith(DIGESTS[name])
