"""Model files to the bit, refused when anything is wrong with them; digests that were recorded once."""

import dataclasses
import io
import os
import pickle
import zipfile

import numpy as np
import pytest
from conftest import real_mesh_path
from helpers import refused
from helpers.samples import SHAPES, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.build.triangle_cover import COVERS_AT_ONCE, SLOTS
from warp_abtree.model import lod_bounds
from warp_abtree.model.model import FORMAT_VERSION, Model

ARRAYS = ("vertex_parent", "vertex_pos", "face_vertex", "face_split", "split_start", "split_face", "lod_error")
MEMBERS = (*ARRAYS, "leaf_node", "format", "version", "name")
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def with_errors(model):
    """Return the model with made-up errors."""
    m = model.lod_max
    errors = np.linspace(1.0, 0.0, m + 1) ** 3 if m else np.zeros(1)
    return Model(dataclasses.replace(model.progressive, known_error=errors), model.tree, model.name)


def assert_same(model, other):
    for name in ARRAYS:
        mine, theirs = getattr(model.progressive, name), getattr(other.progressive, name)
        assert (mine.dtype, mine.shape) == (theirs.dtype, theirs.shape), name
        assert mine.tobytes() == theirs.tobytes(), name
    np.testing.assert_array_equal(model.tree.leaf_node, other.tree.leaf_node)
    np.testing.assert_array_equal(model.tree.node_face, other.tree.node_face)
    np.testing.assert_array_equal(model.dropped_faces, other.dropped_faces)
    np.testing.assert_array_equal(model.centre, other.centre)
    assert (model.name, model.tree.depth) == (other.name, other.tree.depth)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The bytes of a small model file."""
    path = tmp_path_factory.mktemp("content") / "model.npz"
    with_errors(sample("twins")).save(path)
    return path.read_bytes()


@pytest.fixture
def parts(content):
    """The arrays of a model file, to be changed and written by `write`."""
    with np.load(io.BytesIO(content)) as file:
        return {name: file[name] for name in file.files}


def write(path, parts):
    with open(path, "wb") as file:
        np.savez(file, **parts)
    return path


def refuse(path, *words):
    caught = refused(ab.ModelError, None, Model.open, path)
    message = str(caught)
    assert str(path) in message and "\n" not in message and "altered" not in message
    assert all(word in message for word in words)


@pytest.mark.parametrize("name", ["one", "three", "ball", "crumbs", "lattice soup", "twins", "cow"])
def test_round_trip_is_exact(tmp_path, name):
    model = with_errors(sample(name))
    path = tmp_path / "a model.npz"
    model.save(path)
    opened = Model.open(str(path))
    assert_same(model, opened)
    for lod in {0, model.lod_max // 2, model.lod_max}:
        for mine, theirs in zip(model.mesh_at(lod), opened.mesh_at(lod), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    assert [p.name for p in tmp_path.iterdir()] == ["a model.npz"]


def test_equal_models_have_equal_digests(tmp_path):
    """Saved and opened, used, renamed and copied to a worker it is the same; that of any other array is not."""
    model = ab.Model.from_arrays(*SHAPES["crumbs"]())
    ab.Scene("cpu").add(model)
    model.mesh_at(model.lod_max // 2)
    model.save(tmp_path / "model.npz")
    renamed = Model(model.progressive, model.tree, "another")
    for same in (renamed, pickle.loads(pickle.dumps(model)), ab.Model.open(tmp_path / "model.npz")):
        assert same.digest == model.digest
    digests = {model.digest, sample("torus").digest}
    for name in ARRAYS:
        changed = getattr(model.progressive, name).copy()
        changed.flat[-1] += 1
        arrays = {"known_error": model.progressive.lod_error, name.replace("lod_error", "known_error"): changed}
        digests.add(Model(dataclasses.replace(model.progressive, **arrays), model.tree, "").digest)
    assert len(digests) == 2 + len(ARRAYS)


def test_other_files_are_no_models(tmp_path):
    """In the library's own words, which say what reads a mesh."""
    np.save(tmp_path / "a.npy", np.zeros(3))
    for name, array in (("other.npz", np.array([1])), ("objects.npz", np.array([{}])), ("a.zip", np.array([1]))):
        write(tmp_path / name, {"a": array})
    for name, text in (("a.obj", OBJ), ("a.txt", OBJ), ("a.glb", OBJ), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(text)
    for path in tmp_path.iterdir():
        caught = refused(ab.ModelError, r"not a warp_abtree model file.*meshes are read by", Model.open, path)
        assert str(caught).startswith(f"{path}: ")


# Damage; another kind of file, another version, another content.


def test_flipped_and_lost_bytes_are_noticed(tmp_path, content):
    """A file is refused, or opens as it was saved where the byte has no meaning."""
    rng = np.random.default_rng(1)
    path, model = tmp_path / "flipped.npz", with_errors(sample("twins"))
    opened = 0
    for _ in range(400):
        data = bytearray(content if rng.random() < 0.8 else content[: rng.integers(1, len(content))])
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            assert_same(model, Model.open(path))
            opened += 1
        except ab.ModelError as error:
            assert str(path) in str(error)
    assert opened < 200


def test_files_that_are_no_models_are_refused(tmp_path, parts):
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as archive:
        archive.writestr("format.npy", b"text")
    refuse(tmp_path / "zip.npz")
    refuse(tmp_path / "absent.npz", "no such file")
    os.mkfifo(tmp_path / "pipe.npz")
    for path in (tmp_path, tmp_path / "pipe.npz"):
        refuse(path, "no regular file")
    for version in (FORMAT_VERSION + 1, FORMAT_VERSION + 0.5, "new", [1, 1]):
        refuse(write(tmp_path / "m.npz", {**parts, "version": np.array(version)}))
    refuse(write(tmp_path / "m.npz", {**parts, "version": np.array(7)}), "version 7", str(FORMAT_VERSION))
    refuse(write(tmp_path / "m.npz", {**parts, "format": np.array("soup")}), "not a warp_abtree model")


class Bomb:
    """Unpickling this leaves a file behind."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_pickles_are_never_run_and_missing_arrays_are_named(tmp_path, parts):
    trace = tmp_path / "trace"
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Bomb(trace)))
    refuse(tmp_path / "pickle.npz")
    array = np.empty((), object)
    array[()] = Bomb(trace)
    np.save(tmp_path / "object.npy", array, allow_pickle=True)
    refuse(tmp_path / "object.npy")
    for name in MEMBERS:
        refuse(write(tmp_path / "model.npz", {**parts, name: array}))
        # np.load hands out members without the ending .npy raw, pickles too: bytes, not arrays.
        path = write(tmp_path / "model.npz", {key: value for key, value in parts.items() if key != name})
        refuse(path, *([repr(name)] if name not in ("version", "format") else []))
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(name, pickle.dumps(Bomb(trace)))
        refuse(path)
    assert not trace.exists()
    np.load(tmp_path / "object.npy", allow_pickle=True)
    assert trace.exists(), "the bomb would have worked"


# What each array must not hold: array, index, value.
BAD_VALUES = [
    ("vertex_pos", (3, 1), np.nan),
    ("face_vertex", (4, 0), -1),
    ("face_vertex", (4, 0), 42),
    ("vertex_parent", 5, 5),  # its own child
    ("vertex_parent", 5, 6),  # among the originals
    ("vertex_parent", -1, 42),  # below its child
    ("face_split", 2, -1),
    ("face_split", 2, 10**6),
    ("split_start", 0, 1),
    ("split_start", 3, 10**6),
    ("split_start", -1, 3),
    ("split_face", 0, 160),  # no such face
    ("split_face", 0, -1),
    ("lod_error", 0, np.inf),
    ("lod_error", 4, 9.0),  # rises
    ("lod_error", -1, 0.001),
    ("leaf_node", 0, 5),  # inside the tree
    ("leaf_node", slice(2, 4), 190),  # two faces in one leaf
]


# Arrays that fit in type, length and range, but are not one mesh's,
INCONSISTENT = [
    ("vertex_pos", lambda x: x * 2.0**150),
    ("vertex_parent", lambda x: np.full_like(x, -1)),
    ("face_vertex", lambda x: x[::-1]),
    ("face_split", lambda x: x[::-1]),
    ("split_face", lambda x: np.roll(x, 1)),
    ("split_start", lambda x: np.where(np.arange(len(x)) > 0, x[-1], 0)),
]
# and arrays that would make a mesh, but not the one saved.
ALTERED = [
    ("vertex_pos", lambda x: x * 0.5),
    ("lod_error", lambda x: x * 0.5),
    ("leaf_node", lambda x: np.concatenate([x[1::-1], x[2:]])),
    ("name", lambda _: np.array("boll")),
]


def test_types_shapes_and_values_are_checked(tmp_path, parts):
    for name in (*ARRAYS, "leaf_node"):
        good = parts[name]
        for bad in (good.astype(np.complex128), good.astype(np.float32), good[:0], good[None], good[:-1], good[0]):
            refuse(write(tmp_path / "m.npz", {**parts, name: bad}))
    for name, index, value in BAD_VALUES:
        bad = parts[name].copy()
        bad[index] = value
        refuse(write(tmp_path / "m.npz", {**parts, name: bad}))
    for name, change in INCONSISTENT + ALTERED:
        path = write(tmp_path / "m.npz", {**parts, name: change(parts[name])})
        said = "altered since it was saved" if (name, change) in ALTERED else ""
        refused(ab.ModelError, rf"m\.npz: {said}", Model.open, path)


def test_lods_and_requests_of_lods_are_checked():
    model = sample("twins")
    for lod in (-1, 10**6, 0.5, True, "1"):
        for call in (model.mesh_at, model.error_at, lambda lod: model.error_at(lod, side="outward")):
            refused(ValueError, f"LOD.*{lod}", call, lod)
        if lod not in (True, "1"):
            refused(ValueError, "lod must", model.progressive.mesh_at, lod)
    for options in ({}, {"fraction": 0.1, "tolerance": 0.1}):
        refused(ValueError, r"fraction|tolerance", model.lod_for, **options)
    bad = {"fraction": (0.0, 1.001, float("nan"), "half"), "tolerance": (-1e-9, 10**400, float("nan"), "fine")}
    for name, value in [(name, value) for name, values in bad.items() for value in values]:
        refused((ValueError, TypeError), name, model.lod_for, **{name: value})
    for source in (None, 3, "no/such/file.obj"):
        refused(ab.MeshError, None, Model.load, source)


def test_requests_of_lods_are_met():
    model = with_errors(sample("ball"))
    counts = [len(model.mesh_at(lod)[1]) for lod in range(model.lod_max + 1)]
    for fraction in (1.0, 0.5, 0.1, 0.01, 1e-9):
        miss = np.abs(np.array(counts) - fraction * model.face_count)
        lod = model.lod_for(fraction=fraction)
        assert miss[lod] == miss.min() and (miss[lod + 1 :] > miss[lod]).all()
    errors = [model.error_at(lod) for lod in range(model.lod_max + 1)]
    for tolerance in (0.0, 1e-3, errors[7], 0.5, 1.0, float("inf")):
        lod = model.lod_for(tolerance=tolerance)
        assert errors[lod] <= tolerance and (lod == 0 or errors[lod - 1] > tolerance)


def height_field(side, height):
    """A grid of side^2 squares whose heights are whole numbers over 64: the same bits on every machine."""
    x, y = np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij")
    corner = x[:-1, :-1] * (side + 1) + y[:-1, :-1]
    halves = (corner, corner + side + 1, corner + side + 2), (corner, corner + side + 2, corner + 1)
    faces = np.concatenate([np.stack(half, -1).reshape(-1, 3) for half in halves])
    return np.stack([x, y, height(x, y) / 64], -1).reshape(-1, 3), faces


def waves(side):
    """Hills of cubic profile and some roughness."""

    def height(x, y):
        return (x % 16) * (16 - x % 16) * 2 + (y % 24) * (24 - y % 24) + (x * x * 7 + y * 13) % 5

    return height_field(side, height)


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
    faces = (face[None] + 4 * k[:, None, None]).reshape(-1, 3)
    return np.concatenate([vertices, round_, [[3.0, 1.0, 2.0]]]), np.concatenate([faces, fan])


MESHES = {
    "waves": lambda: waves(48),
    "flat": lambda: height_field(24, lambda x, y: 0 * x),
    "crowd": lambda: crowd(60),
}
DIGESTS = {
    "waves": "1c52f25c98c57e2ca8c36a15f84a2025b93f0169463be62182e7ed8cca5cd265",
    "flat": "01fb648983cb8f63f9f962b2aa8e6330114f738e8146cd108bf529e4089134c0",
    "crowd": "e3c3c4aabe7a8e5b3be3829dbea292f12eb72424d3cf3a7745ceb010a8147280",
    "cow": "256eef31a0614cb1",
    "fandisk": "52315ff5f2f51de1",
    "homer": "ff5db907db0ed8c2",
    "stanford-bunny": "1b7f88d4b6470ec2",
}


@pytest.mark.parametrize(("threads", "certify"), [(1, False), (1, True), (2, True)])
@pytest.mark.parametrize("name", MESHES)
def test_a_model_keeps_its_digest(name, threads, certify):
    with testing.regime(cpu_threads=threads):
        assert ab.Model.from_arrays(*MESHES[name](), base_faces=4, certify=certify).digest == DIGESTS[name]


@pytest.mark.parametrize("mesh", [waves(16), crowd(30)], ids=["waves", "crowd"])
def test_covers_of_one_face_at_a_time_give_the_same(mesh, monkeypatch):
    """Where slots may run out, triangles are covered face by face: the same arithmetic without vectors."""
    first = ab.Model.from_arrays(*mesh, base_faces=4, certify=True)
    monkeypatch.setattr(lod_bounds, "SLOTS_PER_FACE", 0)
    monkeypatch.setattr(lod_bounds, "SLOTS_EXTRA", int(COVERS_AT_ONCE * SLOTS) - 1)
    assert ab.Model.from_arrays(*mesh, base_faces=4).digest == first.digest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cow", "fandisk", "homer", "stanford-bunny"])
def test_a_real_model_keeps_its_digest(name):
    with testing.regime(cpu_threads=2):
        assert ab.Model.load(real_mesh_path(name), certify=True).digest.startswith(DIGESTS[name])
