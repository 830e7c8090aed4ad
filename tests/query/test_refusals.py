"""What must not pass unsaid: altered model files, filters that come late, several faults of a frame at once."""

import numpy as np
import pytest
from helpers.samples import SHAPES, sample

import warp_abtree as ab


def rewrite(path, name, change):
    """Write a model file anew with one array changed."""
    with np.load(path) as file:
        arrays = dict(file)
    arrays[name] = change(arrays[name], arrays)
    np.savez(path, **arrays)


def merged(value, arrays):
    """Return where merged vertices begin."""
    return len(arrays["vertex_parent"]) - (len(arrays["lod_error"]) - 1)


def move_merged(value, arrays):
    value = value.copy()
    value[merged(value, arrays) :] *= 2.0**130
    return value


def move_child(value, arrays):
    value = value.copy()
    first = merged(value, arrays)
    child = np.flatnonzero((value[:first] >= 0) & (value[:first] < len(value) - 1))[0]
    value[child] = len(value) - 1
    return value


# Arrays that fit one another in type, length and range, and are still not those of one mesh.
ALTERED = {
    "scaled up": ("vertex_pos", lambda x, _: x * 2.0**150),
    "scaled down": ("vertex_pos", lambda x, _: x * 2.0**-150),
    "in a point": ("vertex_pos", lambda x, _: 0 * x),
    "merged vertices far away": ("vertex_pos", move_merged),
    "all roots": ("vertex_parent", lambda x, _: np.full_like(x, -1)),
    "a merge of three": ("vertex_parent", move_child),
    "faces turned round": ("face_vertex", lambda x, _: x[::-1]),
    "faces without area": ("face_vertex", lambda x, _: np.repeat(x[:, :1], 3, axis=1)),
    "splits turned round": ("face_split", lambda x, _: x[::-1]),
    "always there": ("face_split", lambda x, _: 0 * x),
    "another slice": ("split_face", lambda x, _: np.roll(x, 1)),
    "slices at the end": ("split_start", lambda x, _: np.where(np.arange(len(x)) > 0, x[-1], 0)),
}


@pytest.mark.parametrize("case", ALTERED)
def test_arrays_of_different_meshes_are_refused(tmp_path, case):
    path = tmp_path / "m.npz"
    sample("small ball").save(path)
    ab.Model.open(path)
    rewrite(path, *ALTERED[case])
    with pytest.raises(ab.ModelError, match=r"m\.npz: "):
        ab.Model.open(path)


@pytest.mark.parametrize("name", ["vertex_pos", "lod_error", "leaf_node", "name"])
def test_what_fits_together_is_refused_where_it_was_altered(tmp_path, name):
    path = tmp_path / "m.npz"
    model = ab.Model.from_arrays(*SHAPES["small ball"](), name="ball")
    model.save(path)

    def change(value, _):
        if name == "leaf_node":
            value = value.copy()
            value[:2] = value[1::-1]
            return value
        return np.array("boll") if name == "name" else value * 0.5

    rewrite(path, name, change)
    with pytest.raises(ab.ModelError, match=r"m\.npz: altered since it was saved"):
        ab.Model.open(path)


def test_a_model_that_cannot_be_written_names_the_file_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.m\.npz'$"):
        sample("small ball").save(tmp_path / "none" / "m.npz")


@pytest.mark.parametrize("operator", [ab.Query, ab.ContactQuery, ab.ManifoldQuery])
def test_a_late_filter_is_no_secret(device, operator):
    scene = ab.Scene(device)
    for x in (0.0, 0.5, 1.0):
        scene.add(sample("small ball"), pose=(x, 0, 0, 0, 0, 0, 1))
    query, given = operator(scene), operator(scene, pairs=[(0, 1)])
    query.launch()
    assert [0, 1] in query.result().pairs.tolist()
    scene.filter([(1, 0)])
    with pytest.raises(RuntimeError, match="filtered"):
        query.launch()
    given.launch()
    query = operator(scene)
    query.launch()
    assert [0, 1] not in query.result().pairs.tolist()


def test_a_bad_pose_hides_no_lost_work(device):
    scene = ab.Scene(device)
    for x in (0.0, 0.1):
        scene.add(sample("small ball"), pose=(x, 0, 0, 0, 0, 0, 1))
    frame = ab.FrameGraph(scene, output="faces", capacity=1)
    poses = frame.poses.numpy().copy()
    frame.poses.fill_(np.nan)
    frame.lods.fill_(10**6)
    frame.launch()
    frame.poses.assign(poses)
    with pytest.raises(ab.CapacityError, match=r"hits=.*poses: 2 rows.*lods: 2 entries"):
        frame.check()


@pytest.mark.parametrize("name", ["density", "friction", "slop", "sleep_speed"])
def test_bodies_of_infinite_numbers_are_refused(device, name):
    scene = ab.Scene(device)
    scene.add(sample("small ball"))
    with pytest.raises(ValueError, match=f"{name}: inf of object 0"):
        ab.Dynamics(scene, **{name: np.inf})


@pytest.mark.parametrize("count", [0, 1.5, np.nan, np.inf, "ten", None, True])
def test_faces_of_a_base_are_a_whole_number(count):
    with pytest.raises(ValueError, match="base_faces"):
        ab.Model.from_arrays(np.eye(3), [[0, 1, 2]], base_faces=count)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_recorded_times_are_finite(tmp_path, value):
    path = tmp_path / "rows.csv"
    stages = ["select_ms", "refine_ms", "move_ms", "broad_ms", "query_ms", "answer_ms"]
    path.write_text(",".join(stages) + f"\n0,0,0,0,{value},0\n")
    with pytest.raises(ValueError, match=r"rows\.csv: .*not finite"):
        ab.ReplayClock(path)
