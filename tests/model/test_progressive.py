"""The progressive mesh against a plain replay of its merges, and its certified error against measured distances."""

import dataclasses
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers import samples
from helpers.samples import corners_of, of_trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles.distance import brute_distances, exact_distance_sq, farthest_points

from warp_abtree import testing
from warp_abtree.model import collapse, lod_bounds
from warp_abtree.model.lod_bounds import OutwardError
from warp_abtree.model.mesh import describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.progressive import build_progressive
from warp_abtree.model.tree import active_build

FUZZ = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
FOREST = ("vertex_parent", "vertex_pos", "face_vertex", "face_split", "split_start", "split_face", "lod_error")


def bumpy_grid():
    vertices, faces = samples.grid(12)
    x, y, _ = vertices.T
    return np.stack([x, y, 0.7 * np.sin(x) * np.cos(1.3 * y)], 1), faces


MESHES = {
    "torus": lambda: of_trimesh(trimesh.creation.torus(1.0, 0.4, 24, 12)),
    "sphere": lambda: of_trimesh(trimesh.creation.icosphere(3)),
    "box": lambda: of_trimesh(trimesh.creation.box().subdivide().subdivide().subdivide()),
    "cylinder": lambda: of_trimesh(trimesh.creation.cylinder(1.0, 2.0, sections=40)),
    "flat grid": lambda: samples.grid(12),
    "bumpy grid": bumpy_grid,
    "crumbs": lambda: samples.crumbs(30),
    # Two hubs of very many faces, joined along a rim.
    "fan": lambda: of_trimesh(trimesh.creation.revolve([[0, -1], [1, 0], [0, 1]], sections=60)),
    "line": lambda: samples.line((1.0, 2.0, -1.0)),
    "one face": lambda: (np.eye(3), [[0, 1, 2]]),
    "same face often": lambda: (np.eye(3), [[0, 1, 2]] * 5 + [[2, 1, 0]]),
}


@st.composite
def soups(draw):
    """Random corners, nonmanifold, with repeated faces and corners; on a lattice with coplanar and coincident ones."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(3, 40))
    lattice = draw(st.sampled_from([0, 2, 4]))
    vertices = rng.integers(0, lattice + 1, (count, 3)) if lattice else rng.normal(size=(count, 3))
    hub = draw(st.booleans())
    faces = rng.integers(0, count, (draw(st.integers(1, 120)), 3))
    faces[:, 0] = np.where(hub & (rng.random(len(faces)) < 0.7), 0, faces[:, 0])
    vertices = np.concatenate([np.asarray(vertices, float), 9 + np.eye(3)])
    return mesh_from_arrays(vertices, np.concatenate([faces, count + np.arange(3)[None]]))


@pytest.fixture(params=MESHES)
def mesh(request):
    return mesh_from_arrays(*MESHES[request.param]())


def replay(mesh, progressive):
    """Collapse literally, one merge at a time, in plain Python; assert everything that the arrays say about it."""
    p = progressive
    m, vertex_count = p.lod_max, len(mesh.vertices)
    assert p.vertex_count == vertex_count and p.face_count == len(mesh.faces)
    assert len(p.vertex_parent) == len(p.vertex_pos) == vertex_count + m
    assert np.isfinite(p.vertex_pos).all()
    assert p.vertex_pos[:vertex_count].tobytes() == mesh.vertices.tobytes()
    faces = {f: list(corners) for f, corners in enumerate(mesh.faces.tolist()) if len(set(corners)) == 3}
    dropped = set(range(len(mesh.faces))) - set(faces)
    assert all(p.face_split[f] == m + 1 for f in dropped)
    active = set(range(vertex_count))
    at = {}
    for f, corners in faces.items():
        for v in corners:
            at.setdefault(v, set()).add(f)
    children = {}
    for node, parent in enumerate(p.vertex_parent.tolist()):
        assert parent == -1 or max(node, vertex_count - 1) < parent < vertex_count + m
        children.setdefault(parent, []).append(node)
    check_lod(p, m, faces)
    for j in range(m):
        a, b = children[vertex_count + j]
        assert a in active and b in active
        active -= {a, b}
        active.add(vertex_count + j)
        touched = at.pop(a, set()) | at.pop(b, set())
        assert any(a in faces[f] and b in faces[f] for f in touched), "no face joins the two"
        at[vertex_count + j] = set()
        for f in touched:
            faces[f] = [vertex_count + j if v in (a, b) else v for v in faces[f]]
            if len(set(faces[f])) < 3:
                assert p.face_split[f] == m - j
                for v in set(faces.pop(f)) - {vertex_count + j}:
                    at[v].discard(f)
            else:
                at[vertex_count + j].add(f)
        i = m - 1 - j
        assert p.split_face[p.split_start[i] : p.split_start[i + 1]].tolist() == sorted(touched)
        assert p.active_count(i) == len(faces) > 0
        if i == 0 or j % max(1, m // 12) == 0:
            check_lod(p, i, faces)
    assert all(p.face_split[f] == 0 for f in faces)
    assert p.split_start[0] == 0 and p.split_start[m] == len(p.split_face)


def check_lod(p, lod, faces):
    """Compare one LOD with the replayed faces, through active_vertices and mesh_at."""
    assert np.flatnonzero(p.face_split <= lod).tolist() == sorted(faces)
    ancestor = p.active_vertices(lod)
    vertices, corners, ids = p.mesh_at(lod)
    assert ids.tolist() == sorted(faces) and ids.dtype == corners.dtype == ancestor.dtype == np.int32
    assert 0 <= corners.min() and corners.max() < len(vertices)
    for f, row in zip(ids.tolist(), corners):
        assert ancestor[p.face_vertex[f]].tolist() == faces[f]
        assert np.array_equal(vertices[row], p.vertex_pos[faces[f]])
    if lod < p.lod_max:
        assert len(np.unique(corners)) == len(vertices)


def surface_points(mesh, count):
    corner = mesh.vertices[np.delete(mesh.faces, mesh.dropped_faces, axis=0)]
    weight = np.random.default_rng(0).dirichlet((1, 1, 1), (max(1, count // len(corner)), len(corner)))
    inside = np.einsum("sfk,fkx->sfx", weight, corner).reshape(-1, 3)
    edges = (corner + np.roll(corner, 1, axis=1)) / 2
    return np.concatenate([corner.reshape(-1, 3), edges.reshape(-1, 3), inside])


def measured_error(mesh, progressive, lod, count=3000):
    vertices, faces, _ = progressive.mesh_at(lod)
    points = surface_points(mesh, count)
    if len(points) * len(faces) > 2_000_000:
        points = farthest_points(points, vertices[faces], 200)  # hours otherwise
    return brute_distances(points, vertices[faces]).max()


def check_error(mesh, progressive, steps=8, count=3000):
    """The bound is monotone, zero at the finest LOD, and never below what is measured."""
    error, m = progressive.lod_error, progressive.lod_max
    assert len(error) == m + 1 and error[m] == 0 and np.isfinite(error).all()
    assert (np.diff(error) <= 0).all()
    extent = np.ptp(mesh.vertices, axis=0).max()
    for lod in {*np.geomspace(1, m + 1, steps).astype(int) - 1, *np.linspace(0, m, steps).astype(int)}:
        assert measured_error(mesh, progressive, lod, count) <= error[lod] + 1e-15 * extent


def assert_same(a, b, names=FOREST):
    for name in names:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_every_prefix_is_a_mesh(mesh):
    replay(mesh, build_progressive(mesh, base_faces=1))


@FUZZ
@given(soups(), st.integers(1, 20))
def test_soups(mesh, base_faces):
    progressive = build_progressive(mesh, base_faces=base_faces)
    replay(mesh, progressive)
    check_error(mesh, progressive, steps=4, count=500)


def test_base_prefix(mesh):
    """The base is reached, and a larger one is a prefix of the sequence for a smaller one."""
    long = build_progressive(mesh, base_faces=1)
    for base_faces in (4, 100):
        short = build_progressive(mesh, base_faces=base_faces)
        left = short.active_count(0)  # no merge leaves a copy of one face
        assert 0 < left <= base_faces or left == len(mesh.faces) == 6
        cut, nodes = long.lod_max - short.lod_max, len(short.vertex_parent)
        assert cut >= 0
        parent = long.vertex_parent[:nodes]
        assert np.array_equal(short.vertex_parent, np.where(parent < nodes, parent, -1))
        assert np.array_equal(short.vertex_pos, long.vertex_pos[:nodes])
        assert np.array_equal(short.face_split, np.maximum(long.face_split - cut, 0))
        assert np.array_equal(short.split_face, long.split_face[long.split_start[cut] :])
        assert np.array_equal(short.lod_error, long.lod_error[cut:])


def test_components_go_last_and_smallest_first():
    progressive = build_progressive(mesh_from_arrays(*samples.crumbs(30)), base_faces=1)
    meshes = [mesh_from_arrays(*progressive.mesh_at(lod)[:2]) for lod in range(progressive.lod_max + 1)]
    components = [describe_mesh(mesh)["components"] for mesh in meshes]
    assert components[0] == 1 and components[-1] == 30
    falls = np.flatnonzero(np.diff(components))
    assert np.array_equal(falls, np.arange(len(falls))), "a component went before an ordinary merge"


@pytest.mark.parametrize(("threads", "certify"), [(1, True), (2, False)])
def test_the_result_does_not_depend_on_launches_and_a_full_heap(mesh, monkeypatch, threads, certify):
    first = build_progressive(mesh, base_faces=1)
    assert first.known_error is None and len(first.lod_error) == first.lod_max + 1
    calls = []
    monkeypatch.setattr(collapse, "MERGES", 3)
    if certify:
        monkeypatch.setattr(collapse, "HEAP_PER_EDGE", 1)
        monkeypatch.setattr(collapse, "HEAP_EXTRA", 8)
    monkeypatch.setattr(lod_bounds, "COVERS", 1)
    with testing.regime(cpu_threads=threads):
        again = build_progressive(mesh, base_faces=1, progress=lambda *call: calls.append(call), certify=certify)
        assert_same(first, again)
    stages = ("collapse", "LOD bounds") if certify else ("collapse",)
    assert {stage for stage, _, _ in calls} <= set(stages)
    for stage in stages:
        done = [call[1] for call in calls if call[0] == stage]
        assert done == sorted(done)
        assert threads > 1 or first.lod_max == 0 or len(done) >= first.lod_max // 3
        assert all(0 <= call[1] <= call[2] for call in calls)


@pytest.mark.parametrize("power", [-90, 60])
def test_scale_changes_nothing(mesh, power):
    scaled = SimpleNamespace(vertices=np.ldexp(mesh.vertices, power), faces=mesh.faces)
    one, other = build_progressive(mesh, base_faces=1), build_progressive(scaled, base_faces=1)
    assert_same(one, other, ("vertex_parent", "face_split", "split_start", "split_face"))
    assert np.array_equal(np.ldexp(one.vertex_pos, power), other.vertex_pos)
    assert np.array_equal(np.ldexp(one.lod_error, power), other.lod_error)
    bounds = [OutwardError(each, active_build(each.vertex_pos, each.face_vertex)) for each in (one, other)]
    for lod in {0, one.lod_max // 2}:
        assert np.ldexp(bounds[0].at(lod), power) == bounds[1].at(lod)


@pytest.mark.slow
def test_far_from_the_origin():
    mesh = mesh_from_arrays(*bumpy_grid())
    far = mesh_from_arrays(mesh.vertices + [1e9, -1e9, 3e8], mesh.faces)
    progressive = build_progressive(far, base_faces=4)
    replay(far, progressive)
    # rounding breaks ties differently, so the sequences differ; their quality must not
    near = build_progressive(mesh, base_faces=4)
    lod = near.lod_for(fraction=0.3)
    assert progressive.lod_error[lod] == pytest.approx(near.lod_error[lod], rel=0.5)
    # measured about the mesh's own centre, exactly shifted, as distances far out are not to be had in float64
    shift = far.vertices[0]
    here = mesh_from_arrays(far.vertices - shift, far.faces)
    check_error(here, dataclasses.replace(progressive, vertex_pos=progressive.vertex_pos - shift))


@pytest.mark.parametrize(("name", "limit"), [("torus", 1.3), ("bumpy grid", 1.5), ("cow", 1.2), ("fandisk", 1.2)])
@pytest.mark.slow
def test_error_is_tight(name, limit, real_mesh_path):
    known = name in MESHES
    mesh = mesh_from_arrays(*MESHES[name]()) if known else load_mesh(real_mesh_path(name))
    progressive = build_progressive(mesh, base_faces=4 if known else 10)
    lods = np.linspace(progressive.lod_max - 1, 0, 10).astype(int)
    worst = 0.0
    for lod in lods if known else [progressive.lod_for(fraction=fraction) for fraction in (0.1, 0.01)]:
        worst = max(worst if known else 0.0, measured_error(mesh, progressive, lod))
        assert progressive.lod_error[lod] <= limit * worst


def test_flat_regions_cost_nothing():
    for name, count in (("box", 12), ("flat grid", 2)):
        mesh = mesh_from_arrays(*MESHES[name]())
        progressive, size = build_progressive(mesh, base_faces=count), np.ptp(mesh.vertices, axis=0).max()
        lod = progressive.lod_for(fraction=count / progressive.face_count)
        assert progressive.lod_error[lod] < 1e-6, name
        outward = OutwardError(progressive, active_build(progressive.vertex_pos, progressive.face_vertex))
        assert outward.at(lod) < 1e-8 * size and outward.at(progressive.lod_max) == 0, name


@pytest.mark.parametrize("name", ["cow", "fandisk", "fcl-env", "homer"])
@pytest.mark.slow
def test_real_meshes(name, real_mesh_path):
    mesh = load_mesh(real_mesh_path(name))
    progressive = build_progressive(mesh)
    assert progressive.active_count(0) <= 10
    replay(mesh, progressive)
    check_error(mesh, progressive, steps=4, count=2000)


def bumpy_sheet(size, height, seed):
    vertices, faces = samples.grid(size)
    vertices += np.random.default_rng(seed).uniform(-height, height, vertices.shape)
    return mesh_from_arrays(vertices, faces)


def test_no_vertex_lies_beyond_the_error():
    """The vertex that decides the error is measured with roundings, and would lie beyond it by some of them."""
    close = 0
    for seed in range(6):
        progressive = build_progressive(bumpy_sheet(2, 0.3, seed), base_faces=1)
        original = [[Fraction(x) for x in p] for p in progressive.vertex_pos[: progressive.vertex_count].tolist()]
        for lod in range(progressive.lod_max):
            farthest = max(exact_distance_sq(p, corners_of(progressive, lod)) for p in original)
            bound = Fraction(float(progressive.lod_error[lod])) ** 2
            assert farthest <= bound
            close += farthest > bound * (1 - Fraction(2) ** -36)
    assert close > 10, "elsewhere no vertex decides the error"


@pytest.mark.parametrize("slots", [0, 8])
def test_covers_on_fewer_faces_than_they_want_are_measured_again(slots, monkeypatch):
    """Polygons that find no slot stand on a face that is used already, perhaps a far one, and the bound must say so."""
    mesh, looser = bumpy_sheet(8, 0.3, 1), 0
    plenty = build_progressive(mesh, base_faces=1, certify=True)
    monkeypatch.setattr(lod_bounds, "SLOTS_PER_FACE", 0)
    monkeypatch.setattr(lod_bounds, "SLOTS_EXTRA", slots)
    progressive = build_progressive(mesh, base_faces=1)
    for lod in range(0, progressive.lod_max, 5):
        assert measured_error(mesh, progressive, lod) <= progressive.lod_error[lod] + 1e-13
        looser += progressive.lod_error[lod] > plenty.lod_error[lod]
    assert looser > 0, "there is no want of slots here"
