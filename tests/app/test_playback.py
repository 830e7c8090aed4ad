"""What the viewer looks at: scene files, recordings and meshes, snapshot by snapshot, and what it refuses."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.viewer import BODIES, SCENE, make_models, make_playback, write_scene

import warp_abtree as ab
from warp_abtree.app.open_playback import lay_out, open_playback
from warp_abtree.app.playback import RecordedPlayback, ScenePlayback
from warp_abtree.app.recording import record_run


@pytest.fixture(scope="module")
def models():
    return make_models()


@pytest.fixture
def playback(models, device):
    return make_playback(models, device)


def test_meshes_sweep_and_stay_where_they_are_held(playback):
    lods = [playback.step("count").lods for _ in range(3)]
    top = [playback.scene.models[i].lod_max for i in playback.scene.object_model]
    assert lods[0].tolist() == top and (lods[2] < top).all()
    playback.held[1] = 5
    snapshot = playback.query("faces")
    assert snapshot.lods[1] == 5 and snapshot.lods[0] == lods[2][0] and snapshot.number == 2 and snapshot.row is None
    after = playback.step("faces")
    assert after.lods[1] == 5 and after.lods[0] < lods[2][0] and after.number == 3
    assert after.row.hits == len(after.result.faces)
    playback.held.clear()
    playback.choose("hold")
    before = playback.scene.lods
    assert playback.step("count").lods.tolist() == before.tolist()
    playback.restart()
    assert playback.query("count").lods.tolist() == top and playback.time == 0
    assert playback.step("count").lods.tolist() == top, "still held, from the start"


def test_moving_a_mesh(playback):
    before = playback.query("faces")
    assert before.result.any.all() and len(before.result.any) == 2
    playback.move(2, (50, 0, 0, 0, 0, 0, 1))
    after = playback.query("faces")
    assert len(after.result.pairs) == 1 and after.poses[2, 0] == 50 and before.poses[2, 0] != 50
    playback.restart()
    assert playback.query("faces").poses[2, 0] == before.poses[2, 0]


def test_a_scene_plays_as_it_runs(tmp_path, device):
    path = write_scene(tmp_path)
    playback = open_playback([str(path)], device)
    assert isinstance(playback, ScenePlayback) and playback.modes() == ["scene", "hold", "predictive", "paper"]
    loaded = ab.load_scene(path, device=device)
    frame = loaded.frame(output="faces")
    for k in range(5):
        snapshot, result = playback.step("faces"), frame.step()
        assert snapshot.row.hits == frame.history[-1].hits and snapshot.number == k
        assert np.array_equal(snapshot.result.faces, result.faces)
        assert np.array_equal(snapshot.lods, loaded.scene.lods)
        assert np.array_equal(snapshot.poses, loaded.motion.poses(0.25 * k))
    playback.choose("predictive", 50.0)
    assert playback.budget_ms == 50 and playback.step("count").row.budget_ms == 50
    with pytest.raises(ValueError, match="needs lod"):
        playback.choose("tolerance")
    assert playback.budget_ms == 50
    playback.held[0] = 3
    assert playback.step("count").lods[0] == 3
    playback.choose("scene")
    assert playback.step("count").row.budget_ms is None
    playback.restart()
    assert playback.step("count").number == 0


def test_controllers_look_from_the_page(tmp_path, device):
    path = write_scene(tmp_path, SCENE + "[camera]\neye = [0, 0, 5]\ntarget = [0, 0, 0]\n")
    playback = open_playback([str(path)], device)
    seen = []
    playback.choose("predictive", 9.0)
    eye = ab.Camera.look_at(eye=(0, 9, 1), target=(0, 0, 0))
    for playback.for_page, playback.page_camera in ((False, eye), (True, eye), (True, None)):
        seen.append(playback._camera_at(0.0).eye.tolist())
    assert seen == [[0, 0, 5], [0, 9, 1], [0, 0, 5]]


def test_rigid_bodies_are_shown_where_they_stand(tmp_path, device):
    playback = open_playback([str(write_scene(tmp_path, BODIES))], device)
    snapshots = [playback.step("contacts") for _ in range(20)]
    heights = [snapshot.poses[1, 1] for snapshot in snapshots]
    assert (np.diff(heights[:8]) < 0).all()
    again = playback.query("contacts")
    assert again.poses[1, 1] == heights[-1]
    for snapshot in (*snapshots, again):
        scene = ab.Scene(device=device)
        for i in range(2):
            scene.add(playback.scene.models[playback.scene.object_model[i]], snapshot.poses[i])
        assert len(scene.intersect(output="faces").faces) == len(snapshot.result.faces)
    assert any(len(snapshot.result.faces) for snapshot in snapshots)


def test_a_recording_is_shown_as_it_was(tmp_path, device):
    loaded = ab.load_scene(write_scene(tmp_path), device=device)
    _, recording = record_run(loaded, 4)
    path = tmp_path / "run.npz"
    recording.save(path)
    playback = open_playback([str(path)], device)
    assert (
        isinstance(playback, RecordedPlayback)
        and playback.length == playback.frames == 4
        and playback.modes()[-1] == "hold"
    )
    for k in (0, 1, 2, 3, 0):
        snapshot = playback.step("count")
        assert snapshot.number == k and np.array_equal(snapshot.lods, recording.lods[k])
        assert np.array_equal(snapshot.poses, recording.poses[k])
        assert snapshot.row == recording.rows[k] and snapshot.result.count.sum() == recording.rows[k].hits
    playback.seek(2)
    assert playback.query("count").result.count.sum() == recording.rows[2].hits
    playback.held[0] = 2
    assert playback.step("count").lods[0] == 2
    with pytest.raises(ValueError, match="holds its LODs"):
        playback.choose("predictive", 3.0)


def test_meshes_side_by_side_reach_into_each_other(models):
    poses = lay_out([*models, models[0]])
    boxes = []
    for model, pose in zip((*models, models[0]), poses):
        vertices = model.mesh_at(model.lod_max)[0] + pose[:3]
        boxes.append((vertices.min(axis=0), vertices.max(axis=0)))
    for (_, upper), (lower, _) in itertools.pairwise(boxes):
        assert upper[0] - lower[0] == pytest.approx(0.25 * 2.0)
    assert np.allclose([0.5 * (low + high)[1:] for low, high in boxes], 0)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    trimesh.creation.box().export("ball.obj")
    ab.Model.from_arrays(np.eye(3), [[0, 1, 2]]).save("face.npz")
    Path("junk.npz").write_bytes(b"junk")
    Path("bad.toml").write_text("[scene]\nspeed = 3\n")


BAD = [
    (["gone.toml"], {}, "gone.toml"),
    (["bad.toml"], {}, "scene.speed: unknown key"),
    (["gone.obj"], {}, "gone.obj"),
    (["junk.npz"], {}, "junk.npz"),
    (["ball.obj", "scene.toml"], {}, "scene.toml: a scene file is looked at alone"),
    (["scene.toml"], {"lod": "0.5"}, "--lod: for meshes"),
    (["scene.toml"], {"poses": [[0] * 7]}, "--pose: for meshes"),
    (["ball.obj"], {"objects": 3}, "--objects: for scene files"),
    (["ball.obj"], {"lod": "9999"}, "--lod: model"),
    (["ball.obj"], {"poses": [[0, 0, 0, 0, 0, 0, 1]]}, "--pose: 1 given for the 0 meshes"),
    (["ball.obj", "face.npz"], {"poses": [[0, 0, 0, 0, 0, 0, 2]]}, "--pose: pose 0 has a quaternion"),
]


@pytest.mark.parametrize(("paths", "options", "message"), BAD, ids=[f"{' '.join(p)} {o}" for p, o, _ in BAD])
def test_what_cannot_be_opened(files, paths, options, message):
    with pytest.raises(ValueError) as caught:
        open_playback(paths, "cpu", **options)
    assert message in str(caught.value) and "\n" not in str(caught.value)
