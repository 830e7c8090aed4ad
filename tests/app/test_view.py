"""What the viewer sends, without a browser: geometry of a snapshot, and a viewer scene that notes what it hears."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.viewer import SCENE, make_models, make_playback, place, write_scene

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.open_playback import open_playback
from warp_abtree.app.render_data import Settings, compose, objects_of_world
from warp_abtree.app.styles import COLOURS
from warp_abtree.app.viewer import text as view_text
from warp_abtree.app.viewer import viewer_scene as stages
from warp_abtree.app.viewer.viewer_scene import ViewerScene


@pytest.fixture(scope="module")
def models():
    return make_models()


@pytest.fixture
def playback(models, device):
    return make_playback(models, device)


# Geometry.


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
            assert np.allclose(found, place(snapshot.poses[i], vertices[faces[ids == face][0]]), atol=1e-6)
    only = geometry.intersecting_faces(result, np.array([True, True, False]))
    assert set(only[:, 0].tolist()) == {0, 1} and len(only) < len(intersecting)


def test_contact_lines(playback, monkeypatch):
    result = playback.query("contacts").result
    segments, normals = geometry.contact_lines(result, 0.2, np.ones(3, bool))
    assert len(segments) == len(result.contacts) > 50
    assert np.allclose(segments[:, 0], result.contacts["p0"], atol=1e-6)
    assert np.allclose(segments[:, 1], result.contacts["p1"], atol=1e-6)
    assert np.allclose(normals[:, 0], segments.mean(axis=1), atol=1e-6)
    assert np.allclose(normals[:, 1] - normals[:, 0], 0.2 * result.contacts["normal"], atol=1e-6)
    monkeypatch.setattr(geometry, "LINES", 7)
    fewer, _ = geometry.contact_lines(result, 0.2, np.ones(3, bool))
    assert len(fewer) == 7 and np.array_equal(fewer[[0, -1]], segments[[0, -1]])


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_boxes_of_a_level_hold_the_faces_under_its_nodes(playback, share):
    scene, model = playback.scene, playback.scene.models[1]
    playback.held[1] = model.lod_for(fraction=share)
    snapshot = playback.query("count")
    tree = scene.tree_state(1)
    vertices, faces, ids = model.mesh_at(playback.held[1])
    n = model.face_count
    order = np.argsort([int(tree.face_node[f]) * 2 ** (40 - int(tree.face_node[f]).bit_length()) for f in range(n)])
    for level in (0, 1, 4):
        expected = []
        for i in range(1 << level):
            under = np.isin(ids, order[(i * n) >> level : ((i + 1) * n) >> level])
            if under.any():
                corners = vertices[faces[under]].reshape(-1, 3)
                expected.append((corners.min(axis=0), corners.max(axis=0)))
        found = geometry.level_boxes(tree, level)
        assert found.shape == (len(expected), 2, 3) and np.allclose(found, expected, atol=1e-5)
        lines, count = geometry.tree_lines(scene, snapshot, [1, 0], level)
        assert count >= len(expected) and len(lines) == 12 * count
        first = place(snapshot.poses[1], geometry.box_lines(found).reshape(-1, 3)).reshape(-1, 2, 3)
        assert np.allclose(lines[: len(first)], first, atol=1e-5)
    deepest = geometry.tree_depth(scene, [1])
    assert len(geometry.level_boxes(tree, deepest)) > 0 and len(geometry.level_boxes(tree, deepest + 1)) == 0


def test_boxes_drawn_are_limited_and_counted(playback, monkeypatch):
    snapshot = playback.query("count")
    monkeypatch.setattr(geometry, "BOXES", 10)
    lines, count = geometry.tree_lines(playback.scene, snapshot, [0, 1, 2], 3)
    assert count == 24 and len(lines) == 12 * 10


def test_colours(playback):
    lods = playback.scene.lods
    plain = geometry.object_colours(playback.scene, lods, picked=2)
    assert plain[0].tolist() == [round(255 * part) for part in COLOURS[0][0]]
    assert plain[1].tolist() == [round(255 * part) for part in COLOURS[1][0]]
    assert plain[2].tolist() == [round(255 * part) for part in geometry.PICKED]
    by_lod = geometry.object_colours(playback.scene, np.array([0, lods[1], 1]), by_lod=True)
    assert by_lod[0].tolist() == np.round(255 * geometry.COARSE).tolist()
    assert by_lod[1].tolist() == np.round(255 * geometry.FINE).tolist()


def test_meshes_are_kept_as_long_as_they_fit(playback, monkeypatch):
    cache = geometry.MeshCache(playback.scene)
    first = cache.mesh(0, 100)
    assert cache.mesh(0, 100) is first
    monkeypatch.setattr(geometry, "CACHED_FACES", 200)
    second = cache.mesh(0, 120)
    assert cache.mesh(0, 120) is second and cache.mesh(0, 100) is not first


def test_bounds_hold_all_that_is_shown(playback):
    snapshot = playback.query("count")
    centre, radius = geometry.bounds(geometry.MeshCache(playback.scene), snapshot, np.arange(3))
    for i in range(3):
        vertices = playback.scene.models[playback.scene.object_model[i]].mesh_at(int(snapshot.lods[i]))[0]
        assert np.linalg.norm(place(snapshot.poses[i], vertices) - centre, axis=1).max() <= radius * (1 + 1e-9)
    assert radius < 6


# The viewer scene.


class Handle:
    """Notes what it is given."""

    def __init__(self, log, name):
        self.__dict__.update(log=log, name=name, gone=False)

    def __setattr__(self, key, value):
        self.log.append((self.name, key))
        self.__dict__[key] = value

    def on_click(self, act):
        self.__dict__["click"] = act

    def remove(self):
        self.log.append((self.name, "remove"))
        self.__dict__["gone"] = True


class Api:
    """The scene of a server, without a server."""

    def __init__(self):
        self.log, self.handles = [], {}

    def __getattr__(self, kind):
        def add(name, *arrays, **options):
            self.log.append((name, kind))
            handle = self.handles[name] = Handle(self.log, name)
            handle.__dict__.update(options, arrays=arrays)
            return handle

        return add

    def heard(self):
        log, self.log[:] = list(self.log), []
        return log


class Show:
    """A `ViewerScene` on an `Api`, and a clock that stands until it is told otherwise."""

    def __init__(self, playback):
        self.playback, self.api, self.time, self.picked = playback, Api(), 0.0, []
        self.cache = geometry.MeshCache(playback.scene)
        self.viewer_scene = ViewerScene(self.api, self.cache, self.picked.append, clock=lambda: self.time)
        self.settings = Settings()

    def show(self):
        snapshot = self.playback.query(self.settings.output)
        shown = objects_of_world(self.playback.worlds, self.settings.world)
        data = compose(self.cache, snapshot, shown, self.settings)
        camera = self.playback.camera
        self.viewer_scene.show(data, self.settings, camera and camera(snapshot.time))
        return data, self.api.heard()


def test_only_changes_are_sent(playback):
    show = Show(playback)
    data, heard = show.show()
    assert {name for name, _ in heard} == {
        "/objects/0",
        "/objects/1",
        "/objects/2",
        "/intersecting/0",
        "/intersecting/1",
        "/contacts",
    }
    assert show.viewer_scene.sent > 0 and data.intersecting_count > 0
    assert show.api.handles["/intersecting/0"].color == tuple(round(255 * part) for part in COLOURS[0][1])
    sent = show.viewer_scene.sent
    assert show.show()[1] == [] and show.viewer_scene.sent == sent
    playback.move(2, (50, 0, 0, 0, 0, 0, 1))
    heard = show.show()[1]
    assert ("/objects/2", "position") in heard and ("/objects/2", "vertices") not in heard
    assert not [entry for entry in heard if entry[0] in ("/objects/0", "/objects/1")]
    assert ("/intersecting/0", "vertices") in heard and ("/contacts", "points") in heard
    playback.held[1] = 40
    data, heard = show.show()
    assert {key for name, key in heard if name == "/objects/1"} == {"vertices", "faces"}
    assert len(show.api.handles["/objects/1"].faces) == show.cache.count(1, 40)
    assert data.faces == 2 * 320 + show.cache.count(1, 40)
    assert data.error_mean == pytest.approx(playback.scene.models[1].error_at(40) / 3)
    playback.move(0, (-50, 0, 0, 0, 0, 0, 1))
    heard = show.show()[1]
    assert ("/contacts", "visible") in heard and not show.api.handles["/contacts"].visible
    assert not show.api.handles["/intersecting/1"].visible


def test_settings_reach_the_viewer_scene(playback):
    show = Show(playback)
    show.settings.intersecting = show.settings.contacts = False
    assert show.settings.output == "count"
    _, heard = show.show()
    assert {name for name, _ in heard} == {"/objects/0", "/objects/1", "/objects/2"}
    show.settings.intersecting = True
    assert show.settings.output == "faces" and ("/intersecting/0", "add_mesh_simple") in show.show()[1]
    show.settings.normals = True
    assert show.settings.output == "contacts" and ("/normals", "add_line_segments") in show.show()[1]
    show.settings.level, show.settings.picked = 2, 1
    data, heard = show.show()
    assert ("/tree", "add_line_segments") in heard and ("/objects/1", "color") in heard and data.box_count == 4
    show.settings.every_tree = True
    assert show.show()[0].box_count == 12
    show.settings.level = -1
    show.show()
    assert not show.api.handles["/tree"].visible
    show.settings.wireframe = True
    assert sorted(show.show()[1]) == [(f"/objects/{i}", "wireframe") for i in range(3)]


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
    handle.click(SimpleNamespace(instance_index=1))
    show.api.handles[ring].click(SimpleNamespace(instance_index=0))
    handle.click(SimpleNamespace(instance_index=7))
    assert show.picked == [2, 1]
    assert show.show()[1] == [] and not show.viewer_scene.waits
    # A new mesh is sent out of sight; the object changes to it when the browser has had its time.
    playback.held[2] = 100
    _, heard = show.show()
    assert (f"/meshes/0/{100}", "add_batched_meshes_simple") in heard and show.viewer_scene.waits
    coarse = show.api.handles["/meshes/0/100"]
    assert not coarse.visible and len(handle.batched_positions) == 2
    playback.held[2] = 90
    show.show()
    assert "/meshes/0/90" not in show.api.handles, "one mesh at a time is waited for"
    show.time = 1.0
    show.show()
    assert coarse.visible and len(coarse.batched_positions) == 1 and len(handle.batched_positions) == 1
    coarse.click(SimpleNamespace(instance_index=0))
    assert show.picked[-1] == 2 and show.viewer_scene.waits and "/meshes/0/90" in show.api.handles
    show.time = 2.0
    show.show()
    assert not show.viewer_scene.waits and not coarse.visible and show.api.handles["/meshes/0/90"].visible
    # Meshes that the browser has are not sent again.
    playback.held[2] = 100
    heard = show.show()[1]
    sent = {entry for entry in heard if entry[0].startswith("/meshes")}
    assert sent == {("/meshes/0/100", "visible"), ("/meshes/0/90", "visible")} and coarse.visible
    playback.held[0] = 100
    show.show()
    assert len(coarse.batched_positions) == 2
    for index in (0, 1):
        coarse.click(SimpleNamespace(instance_index=index))
    assert show.picked[-2:] == [0, 2]


def test_hidden_meshes_go_in_time(playback, monkeypatch):
    monkeypatch.setattr(stages, "SINGLE_LIMIT", 0)
    monkeypatch.setattr(stages, "HIDDEN_MESHES", 2)
    show = Show(playback)
    for k in range(6):
        playback.held[0] = 20 + k
        show.show()
        show.time += 1
    show.show()
    gone = [name for name, handle in show.api.handles.items() if handle.gone]
    assert gone == ["/meshes/0/20", "/meshes/0/21", "/meshes/0/22"]
    playback.held[0] = 20
    show.show()
    assert not show.api.handles["/meshes/0/20"].gone, "it came back"


def test_worlds_and_the_camera_of_the_scene(tmp_path):
    text = SCENE + "[camera]\neye = [0, 0, 5]\ntarget = [0, 0, 0]\n"
    playback = open_playback([str(write_scene(tmp_path, text))], "cpu")
    show = Show(playback)
    data, heard = show.show()
    assert data.shown.tolist() == [0, 1] and ("/camera", "add_camera_frustum") in heard
    camera = show.api.handles["/camera"]
    assert np.allclose(camera.position, [0, 0, 5])
    # Seen from there, z of the frustum points to the target and y down.
    w, x, y, z = camera.wxyz
    assert np.allclose(place((0, 0, 0, x, y, z, w), np.eye(3)), [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    show.settings.world = 2
    data, heard = show.show()
    assert data.shown.tolist() == [3] and ("/objects/3", "add_mesh_simple") in heard
    assert not show.api.handles["/objects/0"].visible and data.contact_count == 0


# Words.


def test_numbers_of_an_object(playback):
    snapshot = playback.query("count")
    cache = geometry.MeshCache(playback.scene)
    assert view_text.numbers(playback, snapshot, cache, None) == view_text.NOBODY
    found = view_text.numbers(playback, snapshot, cache, 1)
    assert "| faces | 576 of 576 |" in found and "| meets | #0, #2 |" in found
    assert f"| intersecting face pairs | {snapshot.result.count.sum():,} |" in found
    playback.held[0] = 7
    found = view_text.numbers(playback, playback.query("count"), cache, 0)
    assert f"7 of {playback.scene.models[0].lod_max}, held" in found and "| objects on its tree | 1 |" in found


def test_times_are_stacked(playback):
    rows = [playback.step("count").row for _ in range(4)]
    plot = view_text.time_plot(rows, 0)
    assert len(plot["data"]) == len(plot["series"])
    assert plot["data"][0].tolist() == [0, 1, 2, 3]
    assert np.allclose(plot["data"][1], [row.total_ms for row in rows])
    assert np.allclose(plot["data"][-2], [row.select_ms for row in rows])
    assert plot["data"][-1].tolist() == [0] * 4
    wide = view_text.time_plot(rows, 10)["data"]
    assert wide[0].tolist() == list(range(-6, 4)) and wide[1][:6].tolist() == [0] * 6
    assert [part[6:].tolist() for part in wide[1:-1]] == [part.tolist() for part in plot["data"][1:-1]]
    assert len(view_text.time_plot([], 10)["data"][0]) == 10
    times = [SimpleNamespace(total_ms=ms, budget_ms=None) for ms in (*[2.1] * 99, 900.0)]
    assert view_text.time_top(times) == 3 and view_text.time_top([]) == 1
    times[-1].budget_ms = 50.0
    assert view_text.time_top(times) == 50
