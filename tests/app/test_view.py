"""Playbacks of scene files and meshes; geometry of a snapshot, panels, and what a viewer scene sends."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import refused
from helpers.scenes import scene_with
from helpers.viewer import BODIES, make_playback, write_scene
from oracles.motion import posed

from warp_abtree.app import load_scene
from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.pictures import scenes
from warp_abtree.app.pictures.render import camera_around
from warp_abtree.app.playback import ScenePlayback, open_playback
from warp_abtree.app.render_data import Settings, compose, make_legend, objects_of_world
from warp_abtree.app.styles import COLOURS
from warp_abtree.app.viewer import viewer_scene as stages
from warp_abtree.app.viewer.viewer_scene import ViewerScene


@pytest.fixture
def playback(device):
    return make_playback(device)


def test_intersecting_faces_and_triangles(playback):
    snapshot = playback.query("faces")
    result = snapshot.result
    intersecting = geometry.intersecting_faces(result, np.ones(3, bool))
    expected = set()
    for pair, a, b in result.faces.tolist():
        expected |= {(int(result.pairs[pair, 0]), a), (int(result.pairs[pair, 1]), b)}
    assert [tuple(row) for row in intersecting.tolist()] == sorted(expected) and len(expected) > 50
    cache = geometry.MeshCache(playback.scene)
    lifted = geometry.intersecting_triangles(cache, snapshot, intersecting)
    assert sum(map(len, lifted.values())) == 2 * len(intersecting)
    for owner, pair in lifted.items():
        above, below = np.split(pair, 2)
        corners, step = 0.5 * (above + below), 0.5 * (above - below)
        assert np.allclose(np.linalg.norm(step, axis=2), geometry.LIFT * cache.diagonals[owner], rtol=1e-3)
        edge = corners[:, 1] - corners[:, 0]
        assert np.abs(np.einsum("ti,ti->t", edge, step[:, 0])).max() < 1e-5
        mine = [(i, face) for i, face in intersecting.tolist() if playback.scene.object_model[i] == owner]
        for (i, face), found in list(zip(mine, corners))[::7]:
            vertices, faces, ids = playback.scene.models[owner].mesh_at(int(snapshot.lods[i]))
            assert np.allclose(found, posed(vertices[faces[ids == face][0]], snapshot.poses[i]), atol=1e-6)
    only = geometry.intersecting_faces(result, np.array([True, True, False]))
    assert set(only[:, 0].tolist()) == {0, 1} and len(only) < len(intersecting)


def test_colours_and_legend_tell_models_or_lods(playback):
    lods = np.array([0, playback.scene.lods[1], 1])
    plain, by_lod = (geometry.object_colours(playback.scene, lods, by_lod=by_lod) for by_lod in (False, True))
    assert np.array_equal(plain[:2], np.round([255 * np.array(COLOURS[i][0]) for i in (0, 1)]))
    assert np.array_equal(by_lod[:2], np.round([255 * geometry.COARSE, 255 * geometry.FINE]))
    part = np.linspace(0, 1, 50)[:, None, None]
    ramp = (1 - part) * geometry.COARSE + part * geometry.FINE
    assert np.linalg.norm(ramp - np.array([bright for _, bright in COLOURS]), axis=2).min() > 0.4
    data = compose(geometry.MeshCache(playback.scene), playback.query("faces"), np.arange(3), Settings())
    names = [model.name for model in playback.scene.models]
    plain, by_lod = ([label for _, label in make_legend(playback.scene, [data], lods)] for lods in (False, True))
    assert plain == [names[0], f"{names[0]}, intersecting", names[1], f"{names[1]}, intersecting"]
    assert by_lod == ["coarsest LOD", "finest LOD", plain[1], plain[3]]


def test_the_camera_sees_all_points():
    eye = (0.4, 0.35, 1.0)
    points = np.random.default_rng(3).normal(size=(500, 3)) * [5, 1, 0.2] + [10, 0, 0]
    camera = camera_around(points, eye, (0, 1, 0))
    assert np.allclose(camera.view[2], np.array(eye) / np.linalg.norm(eye)) and camera.view[1, 1] > 0
    local = (points - camera.eye) @ camera.view.T
    assert (local[:, 2] < 0).all()
    assert np.abs(local[:, :2] / local[:, 2:]).max() <= np.tan(0.5 * camera.field_of_view)


class Handle:
    def __init__(self, log, name, options):
        self.__dict__.update(options, log=log, name=name, gone=False)

    def __setattr__(self, key, value):
        self.log.append((self.name, key))
        self.__dict__[key] = value

    def remove(self):
        self.__dict__["gone"] = True

    def on_click(self, act):
        self.__dict__["click"] = act


class Api:
    """The scene of a server, without a server."""

    def __init__(self):
        self.log, self.handles = [], {}

    def __getattr__(self, kind):
        def add(name, **options):
            self.log.append((name, kind))
            self.handles[name] = Handle(self.log, name, options)
            return self.handles[name]

        return add


class Show:
    """A `ViewerScene` on an `Api`, a clock that stands until it is told otherwise, and what was picked."""

    def __init__(self, playback):
        self.playback, self.api, self.time, self.picked = playback, Api(), 0.0, []
        self.cache = geometry.MeshCache(playback.scene)
        self.viewer_scene = ViewerScene(self.api, self.cache, clock=lambda: self.time, pick=self.picked.append)
        self.settings = Settings()

    def show(self, held=(), moved=()):
        """Show the scene, objects held at LODs or moved along x by index; return the data, and what was sent."""
        playback = self.playback
        if held:
            lods = playback.chosen.copy()
            lods[list(held)] = list(held.values())
            playback.hold(lods)
        for i in moved:
            playback._poses[i, 0] = moved[i]
            playback.scene.set_poses(playback._poses)
        snapshot = playback.query(self.settings.output)
        data = compose(self.cache, snapshot, objects_of_world(playback.worlds, self.settings.world), self.settings)
        self.viewer_scene.show(data)
        heard, self.api.log[:] = list(self.api.log), []
        return data, heard


def test_only_changes_are_sent(playback):
    show = Show(playback)
    data, heard = show.show()
    kinds = ("objects/0", "objects/1", "objects/2", "intersecting/0", "intersecting/1")
    assert {name for name, _ in heard} == {f"/{kind}" for kind in kinds}
    assert show.viewer_scene.sent > 0 and data.intersecting_count > 0
    assert show.api.handles["/intersecting/0"].color == tuple(round(255 * part) for part in COLOURS[0][1])
    sent = show.viewer_scene.sent
    assert show.show()[1] == [] and show.viewer_scene.sent == sent
    heard = show.show(moved={2: 50})[1]
    assert ("/objects/2", "position") in heard and ("/objects/2", "vertices") not in heard
    assert not [entry for entry in heard if entry[0] in ("/objects/0", "/objects/1")]
    assert ("/intersecting/0", "vertices") in heard
    data, heard = show.show({1: 40})
    assert {key for name, key in heard if name == "/objects/1"} == {"vertices", "faces"}
    assert len(show.api.handles["/objects/1"].faces) == len(show.cache.mesh(1, 40)[1])
    assert data.faces == 2 * 320 + len(show.cache.mesh(1, 40)[1])
    assert data.error_mean == pytest.approx(playback.scene.models[1].error_at(40) / 3)
    heard = show.show(moved={0: -50})[1]
    assert ("/intersecting/1", "visible") in heard and not show.api.handles["/intersecting/1"].visible


def test_settings_reach_the_viewer_scene(playback):
    show = Show(playback)
    show.settings.intersecting = False
    assert show.settings.output == "count"
    assert {name for name, _ in show.show()[1]} == {"/objects/0", "/objects/1", "/objects/2"}
    show.settings.intersecting = True
    assert show.settings.output == "faces" and ("/intersecting/0", "add_mesh_simple") in show.show()[1]
    show.settings.by_lod = True
    assert sorted(show.show()[1]) == [(f"/objects/{i}", "color") for i in range(3)]
    show.settings.wireframe = True
    assert sorted(show.show()[1]) == [(f"/objects/{i}", "wireframe") for i in range(3)]
    show.api.handles["/objects/1"].click(None)
    assert show.picked == [1]
    show.settings.selected = 1
    for level, count in ((0, 1), (2, 4)):
        show.settings.tree_level = level
        show.show()
        assert show.api.handles["/boxes"].points.shape == (12 * count, 2, 3)
    show.settings.selected = None
    show.show()
    assert not show.api.handles["/boxes"].visible


def test_distances_are_drawn_between_nearest_points(playback, monkeypatch):
    scene, result = playback.scene, playback.query("count").result
    all_pairs, _ = geometry.nearest_points(scene, np.arange(3), result)
    with monkeypatch.context() as patch:
        patch.setattr(geometry, "FEW_OBJECTS", 2)  # of many objects, where boxes overlap
        near, _ = geometry.nearest_points(scene, np.arange(3), result)
    assert len(near) < len(all_pairs) and len(near) == (scene.intersect(result.pairs, "distance").distance > 0).sum()
    show = Show(playback)
    assert not len(show.show()[0].nearest) and "/distances" not in show.api.handles
    show.settings.distances = True
    for x in (6.0, 7.0):
        data, _ = show.show(moved={2: x})
        found = playback.scene.intersect(np.array([[0, 1], [0, 2], [1, 2]]), output="distance")
        apart = found.distance > 0
        assert apart.tolist() == [False, True, True]
        np.testing.assert_array_equal(data.distance, found.distance[apart])
        line = show.api.handles["/distances"]
        np.testing.assert_array_equal(line.points, found.points[apart].astype(np.float32))
        least = data.distance.argmin()
        label = show.api.handles["/distance/0"]
        assert float(label.text) == pytest.approx(data.distance[least], rel=1e-3)
        np.testing.assert_allclose(label.position, data.nearest[least].mean(axis=0))
    panel = scenes.make_panel(show.cache, data)
    assert len(panel.lines[0][0]) == len(panel.labels) == 2
    show.show(moved={2: 0.6})
    assert not show.api.handles["/distance/1"].visible
    show.settings.distances = False
    show.show()
    assert not show.api.handles["/distances"].visible and not show.api.handles["/distance/0"].visible


def test_objects_of_a_model_and_lod_are_instances_of_one_mesh(playback, monkeypatch):
    monkeypatch.setattr(stages, "SINGLE_LIMIT", 0)
    show = Show(playback)
    top = [model.lod_max for model in playback.scene.models]
    _, heard = show.show()
    ball, ring = f"/meshes/0/{top[0]}", f"/meshes/1/{top[1]}"
    assert [name for name, kind in heard if kind == "add_batched_meshes_simple"] == [ball, ring]
    handle = show.api.handles[ball]
    assert handle.batched_positions.shape == (2, 3) and handle.batched_colors.shape == (2, 3)
    assert np.allclose(handle.batched_wxyzs, [[1, 0, 0, 0], [1, 0, 0, 0]])
    assert np.allclose(show.api.handles[ring].batched_wxyzs, [[0.5**0.5, 0.5**0.5, 0, 0]])
    assert show.show()[1] == [] and not show.viewer_scene.waits
    for instance in (1, 0):
        handle.click(SimpleNamespace(instance_index=instance))
    assert show.picked == [2, 0]
    show.settings.wireframe = True
    assert sorted(show.show()[1]) == [(ball, "wireframe"), (ring, "wireframe")]
    # A new mesh is sent out of sight; the object changes to it when the browser has had its time.
    _, heard = show.show({2: 100})
    assert ("/meshes/0/100", "add_batched_meshes_simple") in heard and show.viewer_scene.waits
    coarse = show.api.handles["/meshes/0/100"]
    assert not coarse.visible and len(handle.batched_positions) == 2
    show.show({2: 90})
    assert "/meshes/0/90" not in show.api.handles, "one mesh at a time is waited for"
    show.time = 1.0
    show.show()
    assert coarse.visible and len(coarse.batched_positions) == 1 and len(handle.batched_positions) == 1
    coarse.click(SimpleNamespace(instance_index=0))
    assert show.picked[-1] == 2
    assert show.viewer_scene.waits and "/meshes/0/90" in show.api.handles
    show.time = 2.0
    show.show()
    assert not show.viewer_scene.waits and not coarse.visible and show.api.handles["/meshes/0/90"].visible
    # Meshes that the browser has are not sent again.
    sent = {entry for entry in show.show({2: 100})[1] if entry[0].startswith("/meshes")}
    assert sent == {("/meshes/0/100", "visible"), ("/meshes/0/90", "visible")} and coarse.visible
    show.show({0: 100})
    assert len(coarse.batched_positions) == 2


def test_hidden_meshes_go_in_time(playback, monkeypatch):
    monkeypatch.setattr(stages, "SINGLE_LIMIT", 0)
    monkeypatch.setattr(stages, "HIDDEN_MESHES", 2)
    show = Show(playback)
    for k in range(6):
        show.show({0: 20 + k})
        show.time += 1
    show.show()
    gone = [name for name, handle in show.api.handles.items() if handle.gone]
    assert gone == ["/meshes/0/20", "/meshes/0/21", "/meshes/0/22"]
    show.show({0: 20})
    assert not show.api.handles["/meshes/0/20"].gone, "it came back"


def test_worlds_are_shown_one_at_a_time(tmp_path):
    show = Show(open_playback([str(write_scene(tmp_path))], "cpu"))
    assert show.show()[0].shown.tolist() == [0, 1]
    show.settings.world = 2
    data, heard = show.show()
    assert data.shown.tolist() == [3] and ("/objects/3", "add_mesh_simple") in heard
    assert not show.api.handles["/objects/0"].visible and data.pair_count == 0


def test_meshes_sweep_and_stay_where_they_are_held(device):
    playback = make_playback(device)
    lods = [playback.step("count").lods for _ in range(3)]
    top = [playback.scene.models[i].lod_max for i in playback.scene.object_model]
    assert lods[0].tolist() == top and (lods[2] < top).all()
    lods = playback.scene.lods
    lods[1] = 5
    playback.hold(lods)
    snapshot = playback.query("faces")
    assert snapshot.lods.tolist() == lods.tolist() and snapshot.number == 2 and snapshot.row is None
    after = playback.step("faces")
    assert after.lods.tolist() == lods.tolist() and after.number == 3 and after.row.hits == len(after.result.faces)
    playback.choose("scene")
    assert (playback.step("count").lods < top).all() and playback.scene.lods[1] > 5
    playback.choose("hold")
    before = playback.scene.lods
    assert playback.step("count").lods.tolist() == before.tolist()
    playback.restart()
    assert playback.query("count").lods.tolist() == top and playback.time == 0
    assert playback.step("count").lods.tolist() == top, "still held, from the start"


def test_a_scene_plays_as_it_runs(tmp_path, device):
    path = write_scene(tmp_path)
    playback = open_playback([path], device)
    assert isinstance(playback, ScenePlayback) and playback.modes() == ["scene", "hold", "predictive", "paper"]
    loaded = load_scene(path, device=device)
    frame = loaded.frame(output="faces")
    for k in range(5):
        snapshot, result = playback.step("faces"), frame.step()
        assert snapshot.row.hits == frame.history[-1].hits and snapshot.number == k
        assert np.array_equal(snapshot.result.faces, result.faces)
        assert np.array_equal(snapshot.lods, loaded.scene.lods)
        assert np.array_equal(snapshot.poses, loaded.motion.poses(0.25 * k))
    playback.choose("predictive", 50.0)
    assert playback.budget_ms == 50 and playback.step("count").row.budget_ms == 50
    refused(ValueError, "needs lod", playback.choose, "tolerance")
    assert playback.budget_ms == 50
    playback.hold([3] * len(playback.chosen))
    assert playback.step("count").lods[0] == 3
    playback.choose("scene")
    assert playback.step("count").row.budget_ms is None and playback.scene.lods[0] > 3
    playback.restart()
    assert playback.step("count").number == 0


def test_rigid_bodies_are_shown_where_they_stand(tmp_path, device):
    playback = open_playback([write_scene(tmp_path, BODIES)], device)
    snapshots = [playback.step("contacts") for _ in range(20)]
    snapshots.append(playback.query("contacts"))
    heights = [snapshot.poses[1, 1] for snapshot in snapshots]
    assert (np.diff(heights[:8]) < 0).all() and heights[-1] == heights[-2]
    for snapshot in snapshots:
        models = [playback.scene.models[m] for m in playback.scene.object_model]
        scene = scene_with(device, *zip(models, snapshot.poses))
        # Bodies stop where they touch, so that the last bit of a pose decides.
        apart = scene.intersect([(0, 1)], output="distance").distance[0]
        assert (apart < 1e-12) == (len(snapshot.result.faces) > 0)
    assert any(len(snapshot.result.faces) for snapshot in snapshots)
