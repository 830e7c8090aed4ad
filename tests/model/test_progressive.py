"""The progressive mesh against a plain replay of its merges, and its certified error against measured distances."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warp_abtree.model.mesh import describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.progressive import build_progressive

REAL_MESHES = ("cow", "fandisk", "fcl-env", "fcl-rob", "homer", "rocker-arm", "stanford-bunny", "woody")
TORUS = {"major_radius": 1.0, "minor_radius": 0.4, "major_sections": 24, "minor_sections": 12}
FUZZ = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
FOREST = ("vertex_parent", "vertex_pos", "face_vertex", "face_split", "split_start", "split_face", "lod_error")


# --- meshes -----------------------------------------------------------------------------------------------------------


def welded(vertices, faces):
    """Weld as warp_abtree.mesh promises to: distinct vertices, all used, faces at their index."""
    vertices, inverse = np.unique(np.asarray(vertices, float) + 0.0, axis=0, return_inverse=True)
    used, faces = np.unique(inverse.reshape(-1)[np.asarray(faces)], return_inverse=True)
    return SimpleNamespace(vertices=vertices[used], faces=faces.reshape(-1, 3).astype(np.int32))


def of_shape(shape):
    return welded(shape.vertices, shape.faces)


def torus():
    return of_shape(trimesh.creation.torus(**TORUS))


def grid(size=12, bump=0.0):
    x, y = np.meshgrid(np.arange(size + 1.0), np.arange(size + 1.0))
    z = bump * np.sin(x) * np.cos(1.3 * y)
    corner = (np.arange(size)[:, None] * (size + 1) + np.arange(size)).ravel()[:, None]
    faces = np.concatenate([corner + [0, 1, size + 2], corner + [0, size + 2, size + 1]])
    return welded(np.stack([x, y, z], 2).reshape(-1, 3), faces)


def crumbs(count=30, seed=1):
    """Many components: spheres, boxes and single triangles strewn about."""
    rng = np.random.default_rng(seed)
    shapes = [
        trimesh.creation.icosphere(1, 0.3),
        trimesh.creation.box((0.4, 0.2, 0.3)),
        trimesh.Trimesh(np.eye(3), [[0, 1, 2]]),
    ]
    vertices, faces, base = [], [], 0
    for i in range(count):
        shape = shapes[i % 3]
        vertices.append(shape.vertices * rng.uniform(0.3, 1.0) + rng.uniform(-2, 2, 3))
        faces.append(shape.faces + base)
        base += len(shape.vertices)
    return welded(np.concatenate(vertices), np.concatenate(faces))


def fan(rim=60):
    """A hub of valence far above any soft limit, closed from below by another."""
    angle = np.linspace(0, 2 * np.pi, rim, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    i = np.arange(rim)
    up = np.stack([i, (i + 1) % rim, 0 * i + rim], 1)
    down = np.stack([(i + 1) % rim, i, 0 * i + rim + 1], 1)
    return welded(np.concatenate([circle, [[0, 0, 1.0], [0, 0, -1.0]]]), np.concatenate([up, down]))


def line():
    """Faces without area: every corner on one line."""
    x = np.arange(20.0) ** 1.5
    i = np.arange(18)
    return welded(np.stack([x, 2 * x, -x], 1), np.stack([i, i + 1, i + 2], 1))


MESHES = {
    "torus": torus,
    "sphere": lambda: of_shape(trimesh.creation.icosphere(3)),
    "box": lambda: of_shape(trimesh.creation.box().subdivide().subdivide().subdivide()),
    "cylinder": lambda: of_shape(trimesh.creation.cylinder(1.0, 2.0, sections=40)),
    "flat grid": grid,
    "bumpy grid": lambda: grid(12, 0.7),
    "crumbs": crumbs,
    "fan": fan,
    "line": line,
    "one face": lambda: welded(np.eye(3), [[0, 1, 2]]),
    "same face often": lambda: welded(np.eye(3), [[0, 1, 2]] * 5 + [[2, 1, 0]]),
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
    mesh = welded(
        np.concatenate([np.asarray(vertices, float), 9 + np.eye(3)]),
        np.concatenate([faces, count + np.arange(3)[None]]),
    )
    return mesh


@pytest.fixture(params=MESHES)
def mesh(request):
    return MESHES[request.param]()


# --- oracles ----------------------------------------------------------------------------------------------------------


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


def samples(mesh, count, seed=0):
    """Points of the surface, zero-area faces too: corners, edge midpoints, and random ones inside."""
    rng = np.random.default_rng(seed)
    f = mesh.faces
    corner = mesh.vertices[f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]]
    weight = rng.dirichlet((1, 1, 1), (max(1, count // len(corner)), len(corner)))
    inside = np.einsum("sfk,fkx->sfx", weight, corner).reshape(-1, 3)
    edges = (corner + np.roll(corner, 1, axis=1)) / 2
    return np.concatenate([corner.reshape(-1, 3), edges.reshape(-1, 3), inside])


def segment_distance(p, a, b):
    ab = b - a
    size = np.einsum("...x,...x", ab, ab)
    t = np.einsum("...x,...x", p - a, ab) / np.where(size > 0, size, 1)
    return np.linalg.norm(p - (a + np.clip(t, 0, 1)[..., None] * ab), axis=-1)


def surface_distance(points, vertices, faces):
    """Least distance of every point to a surface, by brute force: edges, and the plane where the foot lies inside."""
    result = np.full(len(points), np.inf)
    step = max(1, 2_000_000 // len(points))
    for start in range(0, len(faces), step):
        a, b, c = np.moveaxis(vertices[faces[start : start + step]], 1, 0)
        p = points[:, None]
        best = np.minimum(np.minimum(segment_distance(p, a, b), segment_distance(p, b, c)), segment_distance(p, c, a))
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal, axis=1)
        normal = normal / np.where(size > 0, size, 1)[:, None]
        inside = size > 0
        for u, v in ((a, b), (b, c), (c, a)):
            inside = inside & (np.einsum("pfx,fx->pf", p - u, np.cross(normal, v - u)) >= 0)
        height = np.abs(np.einsum("pfx,fx->pf", p - a, normal))
        result = np.minimum(result, np.where(inside, np.minimum(height, best), best).min(axis=1))
    return result


@wp.kernel(module="unique")
def measure_distance_kernel(mesh: wp.uint64, points: wp.array[wp.vec3], distance_out: wp.array[float]):
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    foot = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    distance_out[i] = wp.length(points[i] - foot)


def far_points(points, vertices, faces, count=200):
    """The points farthest from a surface, as float32 and Warp's own mesh query see it."""
    low, size = points.min(axis=0), np.ptp(points, axis=0).max()
    place = wp.array((points - low) / size, dtype=wp.vec3, device="cpu")
    corners = wp.array((vertices - low) / size, dtype=wp.vec3, device="cpu")
    surface = wp.Mesh(corners, wp.array(faces.ravel(), dtype=int, device="cpu"))
    distance = wp.empty(len(points), dtype=float, device="cpu")
    wp.launch(measure_distance_kernel, len(points), [surface.id, place], [distance], device="cpu")
    return points[np.argsort(distance.numpy())[-count:]]


def measured_error(mesh, progressive, lod, count=3000):
    vertices, faces, _ = progressive.mesh_at(lod)
    points = samples(mesh, count)
    if len(points) * len(faces) > 2_000_000:
        points = far_points(points, vertices, faces)  # hours otherwise
    return surface_distance(points, vertices, faces).max()


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


# --- tests ------------------------------------------------------------------------------------------------------------


def test_every_prefix_is_a_mesh(mesh):
    for link_condition in (False, True):
        replay(mesh, build_progressive(mesh, base_faces=1, link_condition=link_condition))


@FUZZ
@given(soups(), st.integers(1, 20))
def test_soups(mesh, base_faces):
    progressive = build_progressive(mesh, base_faces=base_faces)
    replay(mesh, progressive)
    check_error(mesh, progressive, steps=4, count=500)


@pytest.mark.parametrize("name", MESHES)
def test_the_base_is_reached(name):
    count = build_progressive(MESHES[name](), base_faces=4).active_count(0)
    assert count == 6 if name == "same face often" else 0 < count <= 4  # no merge leaves a copy of one face


def test_base_prefix(mesh):
    """A larger base is a prefix of the sequence for a smaller one."""
    long = build_progressive(mesh, base_faces=1)
    for base_faces in (2, 10, 100):
        short = build_progressive(mesh, base_faces=base_faces)
        cut, nodes = long.lod_max - short.lod_max, len(short.vertex_parent)
        assert cut >= 0
        parent = long.vertex_parent[:nodes]
        assert np.array_equal(short.vertex_parent, np.where(parent < nodes, parent, -1))
        assert np.array_equal(short.vertex_pos, long.vertex_pos[:nodes])
        assert np.array_equal(short.face_split, np.maximum(long.face_split - cut, 0))
        assert np.array_equal(short.split_face, long.split_face[long.split_start[cut] :])
        assert np.array_equal(short.lod_error, long.lod_error[cut:])


def test_components_go_last_and_smallest_first():
    mesh = crumbs()
    progressive = build_progressive(mesh, base_faces=1)
    pieces = [
        describe_mesh(mesh_from_arrays(*progressive.mesh_at(lod)[:2]))["components"]
        for lod in range(progressive.lod_max + 1)
    ]
    assert pieces[0] == 1 and pieces[-1] == 30
    falls = np.flatnonzero(np.diff(pieces))
    assert np.array_equal(falls, np.arange(len(falls))), "a component went before an ordinary merge"


def test_it_is_deterministic_and_resumes(mesh, monkeypatch):
    first = build_progressive(mesh, base_faces=1)
    monkeypatch.setattr("warp_abtree.model.progressive.MERGES_PER_LAUNCH", 3)
    monkeypatch.setattr("warp_abtree.model.progressive.COVERS_PER_LAUNCH", 1)
    calls = []
    second = build_progressive(mesh, base_faces=1, progress=lambda *call: calls.append(call))
    assert_same(first, second)
    assert {stage for stage, _, _ in calls} <= {"collapse", "LOD bounds"}
    for stage in ("collapse", "LOD bounds"):
        done = [call[1] for call in calls if call[0] == stage]
        assert done == sorted(done)
        assert first.lod_max == 0 or len(done) >= first.lod_max // 3
        assert all(0 <= call[1] <= call[2] for call in calls)


def test_a_full_heap_loses_nothing(mesh, monkeypatch):
    first = build_progressive(mesh, base_faces=1)
    monkeypatch.setattr("warp_abtree.model.progressive.HEAP_ROOM", (1, 8))
    assert_same(first, build_progressive(mesh, base_faces=1))


@pytest.mark.parametrize("power", [-90, -3, 1, 60])
def test_scale_changes_nothing(mesh, power):
    """Scaling by a power of two gives the same forest and scales positions and errors to the bit."""
    scaled = SimpleNamespace(vertices=np.ldexp(mesh.vertices, power), faces=mesh.faces)
    one, other = build_progressive(mesh, base_faces=1), build_progressive(scaled, base_faces=1)
    assert_same(one, other, ("vertex_parent", "face_split", "split_start", "split_face"))
    assert np.array_equal(np.ldexp(one.vertex_pos, power), other.vertex_pos)
    assert np.array_equal(np.ldexp(one.lod_error, power), other.lod_error)


@pytest.mark.parametrize("offset", [1e3, 1e9])
@pytest.mark.slow
def test_far_from_the_origin(offset):
    mesh = grid(12, 0.7)
    far = welded(mesh.vertices + [offset, -offset, 0.3 * offset], mesh.faces)
    progressive = build_progressive(far, base_faces=4)
    replay(far, progressive)
    # rounding breaks ties otherwise, so the sequences differ; their quality must not
    near = build_progressive(mesh, base_faces=4)
    lod = near.lod_for(fraction=0.3)
    assert progressive.lod_error[lod] == pytest.approx(near.lod_error[lod], rel=0.5)
    # measured about the mesh's own centre, exactly shifted, as distances far out are not to be had in float64
    shift = far.vertices[0]
    here = SimpleNamespace(vertices=far.vertices - shift, faces=far.faces)
    moved = SimpleNamespace(
        lod_error=progressive.lod_error,
        lod_max=progressive.lod_max,
        mesh_at=lambda lod: (progressive.mesh_at(lod)[0] - shift, *progressive.mesh_at(lod)[1:]),
    )
    check_error(here, moved)


@pytest.mark.slow
def test_error_bounds_what_is_measured(mesh):
    check_error(mesh, build_progressive(mesh, base_faces=1))


@pytest.mark.slow
def test_error_is_tight():
    for name, limit in (("torus", 1.3), ("sphere", 1.3), ("bumpy grid", 1.5)):
        mesh = MESHES[name]()
        progressive = build_progressive(mesh, base_faces=4)
        worst = 0.0
        for lod in np.linspace(progressive.lod_max - 1, 0, 40).astype(int):
            worst = max(worst, measured_error(mesh, progressive, lod))
            assert progressive.lod_error[lod] <= limit * worst, name


def test_flat_regions_cost_nothing():
    for name, count in (("box", 12), ("flat grid", 2)):
        progressive = build_progressive(MESHES[name](), base_faces=count)
        assert progressive.lod_error[progressive.lod_for(fraction=count / progressive.face_count)] < 1e-6, name


def test_lod_for():
    progressive = build_progressive(torus(), base_faces=4)
    counts = progressive.active_count(np.arange(progressive.lod_max + 1))
    assert progressive.lod_for(fraction=1.0) == progressive.lod_max == progressive.lod_for(tolerance=0.0)
    assert progressive.lod_for(tolerance=np.inf) == 0
    for fraction in (0.001, 0.1, 0.33, 0.5, 0.999):
        lod = progressive.lod_for(fraction=fraction)
        assert abs(counts[lod] - fraction * counts[-1]) == np.abs(counts - fraction * counts[-1]).min()
    for tolerance in np.quantile(progressive.lod_error, [0.1, 0.5, 0.9]):
        lod = progressive.lod_for(tolerance=tolerance)
        assert progressive.lod_error[lod] <= tolerance
        assert lod == 0 or progressive.lod_error[lod - 1] > tolerance
    for wish in ({}, {"fraction": 0.5, "tolerance": 1.0}, {"fraction": 0.0}, {"fraction": 1.5}, {"fraction": np.nan}):
        with pytest.raises(ValueError):
            progressive.lod_for(**wish)
    for tolerance in (-1.0, np.nan):
        with pytest.raises(ValueError):
            progressive.lod_for(tolerance=tolerance)


def test_bad_input_is_refused():
    mesh = torus()
    for base_faces in (0, -3, 2.5):
        with pytest.raises(ValueError, match="base_faces"):
            build_progressive(mesh, base_faces=base_faces)
    progressive = build_progressive(mesh)
    for lod in (-1, progressive.lod_max + 1, 0.5):
        with pytest.raises(ValueError, match="lod"):
            progressive.mesh_at(lod)
    broken = mesh.vertices.copy()
    broken[3, 1] = np.nan
    for vertices, faces in (
        (broken, mesh.faces),
        (mesh.vertices, mesh.faces + 1),
        (mesh.vertices, mesh.faces[:0]),
        (mesh.vertices, mesh.faces[:, :2]),
        (mesh.vertices, np.zeros((4, 3), int)),
    ):
        with pytest.raises(ValueError):
            build_progressive(SimpleNamespace(vertices=vertices, faces=faces))


def test_link_condition_leaves_no_coincident_faces():
    shape = {"major_radius": 1.0, "minor_radius": 0.02, "major_sections": 60, "minor_sections": 4}
    mesh = of_shape(trimesh.creation.torus(**shape))
    for link_condition in (False, True):
        progressive = build_progressive(mesh, base_faces=20, link_condition=link_condition)
        repeats = 0
        for lod in range(progressive.lod_max + 1):
            faces = np.sort(progressive.mesh_at(lod)[1], axis=1)
            repeats += len(faces) - len(np.unique(faces, axis=0))
        assert (repeats == 0) == link_condition


@pytest.mark.parametrize("name", REAL_MESHES)
@pytest.mark.slow
def test_real_meshes(name, real_mesh_path):
    mesh = load_mesh(real_mesh_path(name))
    progressive = build_progressive(mesh)
    assert progressive.active_count(0) <= 10
    if len(mesh.faces) < 30_000:
        replay(mesh, progressive)
    check_error(mesh, progressive, steps=4, count=2000)


@pytest.mark.parametrize("name", ["cow", "fandisk"])
@pytest.mark.slow
def test_error_is_tight_on_real_meshes(name, real_mesh_path):
    mesh = load_mesh(real_mesh_path(name))
    progressive = build_progressive(mesh)
    for fraction in (0.1, 0.01):
        lod = progressive.lod_for(fraction=fraction)
        assert progressive.lod_error[lod] <= 1.2 * measured_error(mesh, progressive, lod)
