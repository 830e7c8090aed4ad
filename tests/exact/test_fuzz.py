"""Random and hostile input, end to end: a clear error, or an answer that exact brute force confirms."""

import numpy as np
import pytest
from helpers import refused
from helpers.samples import STILL, true_faces
from helpers.viewer import SCENE
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warp_abtree as ab
from warp_abtree.app import SceneError, load_scene

relaxed = settings(deadline=None, max_examples=250, suppress_health_check=[HealthCheck.function_scoped_fixture])

hostile = st.sampled_from([float("nan"), float("inf"), -float("inf"), 1.7e308, -1e200])
tiny = st.sampled_from([-0.0, 5e-324, -1e-300, 2.0**-290, 1e-60, -1e-17])


@st.composite
def soups(draw):
    """Few corners on a small lattice, so that they often coincide and align, of any size; some tiny, a few hostile."""
    corner = st.integers(-3, 3).map(float) | st.sampled_from([0.1, 1 / 3, -2.7])
    if draw(st.booleans()):
        corner = corner | tiny
    if draw(st.integers(0, 7)) == 7:
        corner = corner | hostile
    vertices = draw(st.lists(st.tuples(corner, corner, corner), min_size=3, max_size=9))
    last = len(vertices) - 1 + (draw(st.integers(0, 15)) == 15)
    index = st.integers(-(draw(st.integers(0, 15)) == 15), last)
    faces = draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=12))
    scale = 2.0 ** draw(st.sampled_from([0, 0, 0, 0, 30, -30, 95, -95, 120, -120]))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(vertices) * scale, np.array(faces)


position = st.floats(-2.0, 2.0) | st.sampled_from([0.0, 0.0, 1.0, 1e300, -1e300, 1e-300])
turn = st.sampled_from(
    [(0, 0, 0, 1), (0, 0, 0, -1), (1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (0, 0, 0.6, 0.8), (0.1, 0.7, 0.1, 0.7)]
    + [(0, 0, 0, 1.0005), (0, 0, 0, 1.1), (0, 0, 0, 0), (float("nan"), 0, 0, 1)]
)


@relaxed
@given(soups(), soups(), st.tuples(position, position, position), turn, st.data())
@pytest.mark.slow
def test_meshes_and_poses(device, soup_a, soup_b, place, turned, data):
    try:
        a, b = (ab.Model.from_arrays(*soup) for soup in (soup_a, soup_b))
    except ab.MeshError as error:
        assert "\n" not in str(error)
        return
    size = np.abs(a.progressive.vertex_pos).max() if data.draw(st.booleans()) else 1.0
    pose = (*(float(x if abs(x) > 2 else x * size) for x in place), *turned)
    scene = ab.Scene(device)
    lods = [data.draw(st.integers(0, model.lod_max)) for model in (a, b)]
    scene.add(a, lod=lods[0])
    try:
        scene.add(b, pose, lod=lods[1])
    except ValueError as error:
        assert "pose" in str(error) and "\n" not in str(error)
        assert scene.object_count == 1
        return
    result = scene.intersect([(0, 1)], output="faces")
    result.check()
    if np.abs(np.asarray(pose[:3])).max() < 1e200:  # beyond, the oracle's own arithmetic overflows
        truth = true_faces(a, lods[0], STILL, b, lods[1], pose)
        np.testing.assert_array_equal(result.faces[:, 1:], truth)
    assert result.any[0] == (len(result.faces) > 0)


@relaxed
@given(st.data())
@pytest.mark.slow
def test_scene_files(tmp_path, data):
    """Damage a scene file by lines and characters: it loads, or one SceneError names the file."""
    text = list(SCENE)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        kind = data.draw(st.sampled_from(["drop", "put", "cut", "twice"]))
        if kind == "put":
            text.insert(at, data.draw(st.sampled_from(list('[]{}="-.0179aen,\n#\x00\\é'))))
        elif kind == "twice":
            text[at:at] = text[at : at + data.draw(st.integers(1, 40))]
        else:
            del text[at : at + (1 if kind == "drop" else data.draw(st.integers(1, 40)))]
    path = tmp_path / "scene.toml"
    path.write_text("".join(text), encoding="utf-8")
    try:
        load_scene(path, device="cpu")
    except SceneError as error:
        assert "scene.toml" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("junk", [b"", b"\xff\xfe", b"PK\x03\x04", b"\x93NUMPY", b"[scene", b"v 0 0 0\nf 1 2 3\n"])
def test_any_file_for_any_other(tmp_path, junk):
    readers = {"a.npz": ab.Model.open, "a.obj": ab.Model.load, "a.ply": ab.Model.load}
    for name, read in {**readers, **({"a.toml": load_scene} if junk else {})}.items():
        (tmp_path / name).write_bytes(junk)
        refused((ab.ModelError, ab.MeshError, SceneError), name.replace(".", r"\."), read, tmp_path / name)
