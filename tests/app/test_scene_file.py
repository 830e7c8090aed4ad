"""Scene files: what a good one makes, and the one line that a bad one gives."""

import math

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.viewer import write_scene

from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.pictures.scenes import panel_lods
from warp_abtree.app.toml import decode, objects, scene_file
from warp_abtree.app.toml.models import FACE_BOUNDS, GENERATED
from warp_abtree.app.toml.tables import SHAPES

BALL = '[models.ball]\nshape = "icosphere"\nsubdivisions = 1\n'
M = '[models.m]\n{}\n[[objects]]\nmodel = "m"\n'
ONE = BALL + '[[objects]]\nmodel = "ball"\n'


def load(tmp_path, text):
    return load_scene(write_scene(tmp_path, text), device="cpu")


def test_smallest_scene(tmp_path):
    loaded = load(tmp_path, ONE)
    assert (loaded.title, loaded.frames, loaded.scene.object_count) == ("scene", 60, 1)
    assert loaded.scene.lods.tolist() == [loaded.models["ball"].lod_max]
    assert np.array_equal(loaded.motion.poses(3.0), [[0, 0, 0, 0, 0, 0, 1]])
    assert loaded.frame().step().any.tolist() == []
    path = tmp_path / "scene.toml"
    path.write_bytes(b"\xef\xbb\xbf" + ONE.replace("\n", "\r\n").encode())  # as Windows writes
    assert load_scene(path, device="cpu").scene.object_count == 1
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    for path, message in ((tmp_path / "gone.toml", ""), (tmp_path, ""), (tmp_path / "bytes.toml", ": not valid TOML")):
        refused(SceneError, f"{path}{message}", load_scene, path, device="cpu")


def test_every_key_of_an_object(tmp_path):
    loaded = load(
        tmp_path,
        'scene = { title = "keys", frames = 7, time_step = 0.5, seed = 3 }\n'
        + ONE
        + """
        name = "first"
        position = [1, 2, 3]
        rotation = { axis = [0, 0, 2], degrees = 90 }
        world = 4
        static = true
        importance = 3
        lod = 9
        velocity = [0, 1, 0]
        turn = { axis = [0, 0, 1], degrees = 180 }
        shuttle = { by = [2, 0, 0], period = 4, phase = 0.25 }
        [[objects]]
        model = "ball"
        rotation = { quaternion = [1, 0, 0, 0] }
        lod = "coarsest"
        """,
    )
    assert (loaded.title, loaded.frames, loaded.time_step) == ("keys", 7, 0.5)
    assert loaded.worlds.tolist() == [4, 0]
    assert loaded.scene.lods.tolist() == [9, 0]
    assert loaded.scene.object_importance == [3, 1]
    half = math.sqrt(0.5)
    # After 1 s: one up, half of the shuttle's way and half as much again; a quarter turn and a half turn.
    assert np.allclose(loaded.motion.poses(1.0), [[3, 3, 3, 0, 0, half, -half], [0, 0, 0, 1, 0, 0, 0]])


def test_copies(tmp_path):
    loaded = load(
        tmp_path,
        'models.box = { shape = "box", extents = [1, 2, 4] }\n'
        + ONE.replace('"ball"\n', '["ball", "box"]\n')
        + """
        grid = { size = [3, 1, 2], spacing = [2, 0, 1] }
        position = [10, 0, 0]
        lod = [0.5, "finest", 1]
        world = 5
        worlds = 2
        """,
    )
    assert loaded.worlds.tolist() == [5] * 6 + [6] * 6
    assert loaded.scene.object_model == [0, 1] * 6
    expected = [[10 + x, 0, z] for x in (-2, 0, 2) for z in (-0.5, 0.5)] * 2
    assert np.allclose(loaded.motion.position, expected)
    ball, box = loaded.models["ball"], loaded.models["box"]
    lods = [ball.lod_for(fraction=0.5), box.lod_max, 1, box.lod_for(fraction=0.5), ball.lod_max, 1]
    assert loaded.scene.lods.tolist() == lods * 2


def test_collision_groups_and_masks(tmp_path):
    """Balls of two teams, all in one place: a team meets the other alone, and what watches meets nothing."""
    teams = "count = 2\ncollision_group = {}\ncollision_mask = {}\n[[objects]]\nmodel = 'ball'\n"
    text = ONE + teams.format("0b01", "0b10") + teams.format("0b10", "0b01") + "collision_mask = 0\n"
    assert load(tmp_path, text).scene.broad_phase().tolist() == [[0, 2], [0, 3], [1, 2], [1, 3]]


def test_random_is_seeded_and_bounded(tmp_path):
    text = ONE + (
        "count = 50\nshuttle = { by = [1, 0, 0], period = 2 }\n"
        "random = { position = [1, 0.5, 0], rotation = true, velocity = 2, turn = 90, phase = true }\n"
    )
    first, again = load(tmp_path, "[scene]\nseed = 1\n" + text), load(tmp_path, "[scene]\nseed = 1\n" + text)
    other = load(tmp_path, "[scene]\nseed = 2\n" + text)
    assert np.array_equal(first.motion.poses(1.0), again.motion.poses(1.0))
    assert not np.allclose(first.motion.poses(1.0), other.motion.poses(1.0))
    motion = first.motion
    assert (np.abs(motion.position) <= [1, 0.5, 0]).all() and np.ptp(motion.position[:, 0]) > 1
    speed = np.linalg.norm(motion.velocity, axis=1)
    assert speed.max() <= 2 and speed.max() > 1
    assert motion.rate.min() >= 0 and math.radians(45) < motion.rate.max() <= math.radians(90)
    assert len(np.unique(motion.phase)) == 50 and len(np.unique(motion.rotation, axis=0)) == 50


def test_sizes(tmp_path):
    trimesh.creation.box(extents=[1, 2, 4]).apply_translation([5, 0, 0]).export(tmp_path / "brick.ply")
    row = '[models.{}]\nmesh = "brick.ply"\n{}\n'
    text = row.format("plain", "") + row.format("sized", "size = 1\ncentre = true") + row.format("scaled", "scale = 3")
    models = load(tmp_path, text + '[[objects]]\nmodel = "plain"\n').models
    for name, lower, upper in (
        ("plain", [4.5, -1, -2], [5.5, 1, 2]),
        ("sized", [-0.125, -0.25, -0.5], [0.125, 0.25, 0.5]),
        ("scaled", [13.5, -3, -6], [16.5, 3, 6]),
    ):
        vertices = models[name].mesh_at(models[name].lod_max)[0]
        assert np.allclose([vertices.min(0), vertices.max(0)], [lower, upper])


def test_sweep_of_a_named_object(tmp_path):
    swept = '[[objects]]\nmodel = "ball"\n[[lod_sweep]]\nobjects = ["a"]\nfrom = 1\nto = 0.25\nperiod = 2\n'
    loaded = load(tmp_path, ONE + 'name = "a"\n' + swept)
    ball = loaded.models["ball"]
    assert loaded.lods_at(0.0).tolist() == [ball.lod_max] * 2
    assert loaded.lods_at(1.0).tolist() == [ball.lod_for(fraction=0.25), ball.lod_max]
    assert [lods[0] for lods in panel_lods(loaded)] == [ball.lod_max, ball.lod_for(fraction=0.25)]
    frame = loaded.frame()
    frame.run(60)
    assert len({row.lod_min for row in frame.history}) > 10


FLAT = M.format('shape = "terrain"\nextents = [1, 1]\ncells = [2, 2]\nbumps = 0\nwaves = 1\nrim = 0')
LARGE = "".join(f"[models.m{i}]\nshape = 'icosphere'\nsubdivisions = 8\n" for i in range(4))
SWEPT = ONE + "[[lod_sweep]]\nfrom = 1\nto = 0.1\nperiod = 1\n"
LOOK = ONE + "[camera]\neye = [0, 0, 1]\n"
KEY = "[[camera.keys]]\ntime = 0\neye = [0, 0, 1]\ntarget = [0, 0, 0]\n"
WINDOW = "count = {}\n[lod]\nbudget_ms = 5\nwindow = 1000\n[camera]\neye = [0, 0, 9]\ntarget = [0, 0, 0]\n"
TWO = "count = 3\n" + ONE[len(BALL) :] + "{}\n"
GRID = "grid = { size = [3, 1, 1], spacing = [1, 1, 1] }"
LODS = "count = 100\nlod = [9, 8, 7, 6{}]\n"
# Limits of a whole file: a low value of one, what may follow `ONE`, what may not, and what is said of that.
LIMITS = {
    "bytes": (decode, "FILE_SIZE_LIMIT", len(ONE), "", "\n", f"the file: has more than {len(ONE)} bytes"),
    # Of which characters have several.
    "letters": (
        decode,
        "FILE_SIZE_LIMIT",
        len(ONE) + 4,
        "# é",
        "# éé",
        f"the file: has more than {len(ONE) + 4} bytes",
    ),
    # A model takes memory once for each LOD that an object begins at, whatever the number of objects.
    "LODs": (
        scene_file,
        "STATE_LIMIT",
        240,
        *map(LODS.format, ("", ", 5")),
        "lod: 5 LODs of 1 models have more than 240",
    ),
    "window": (scene_file, "MOTION_LIMIT", 10**5, *map(WINDOW.format, (100, 101)), "lod.window: 1,000 frames of 101"),
    "worlds": (
        objects,
        "OBJECT_LIMIT",
        5,
        *map(TWO.format, ("worlds = 2", "worlds = 3")),
        "worlds: more than 5 objects",
    ),
    "grid": (objects, "OBJECT_LIMIT", 5, *map(TWO.format, ("", GRID)), r"objects\[1\].grid.size: more than 5 objects"),
}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "models"),
        (BALL, "no [[objects]]"),
        ("[scene\n", "line 1"),
        (ONE + "colour = 3\n", "objects[0].colour: unknown key"),
        (ONE + "[extra]\na = 1\n", "extra: unknown key"),
        ("[scene]\nframes = 0\n" + ONE, "scene.frames: expected a whole number >= 1"),
        ("[scene]\nframes = 1.5\n" + ONE, "scene.frames: expected a whole number, got a number"),
        ("scene = 3\n" + ONE, "scene: expected a table, got a whole number"),
        (M.format(""), "models.m: give mesh or shape"),
        (M.format('shape = "cube"'), "models.m.shape: 'cube' is none of"),
        (M.format('shape = "torus"'), "models.m.shape: torus() missing"),
        (M.format('shape = "box"\nradius = 1'), "models.m.radius: unknown key"),
        (M.format('shape = "box"\nextents = [1, 2]'), "models.m.extents: expected a list of length 3, got 2"),
        (M.format('mesh = "gone.obj"'), "gone.obj: no such file"),
        (M.format('mesh = ["a.obj", "b.obj"]'), "b.obj: no such file"),
        (M.format('shape = "revolve"\nprofile = [[1, 0], [1, 0]]\nsections = 9'), "models.m.shape: profile: z"),
        (M.format('shape = "revolve"\nprofile = [[0, 0], [1, 1]]'), "models.m.profile[0][0]: expected a number > 0"),
        (ONE.replace("[[", "size = 1\nscale = 2\n[["), "give size or scale"),
        (ONE.replace("[[", "scale = 1e300\n[["), "models.ball: "),
        (ONE.replace("[[", "mesh = []\n[["), "models.ball.mesh: expected a list of length >= 1"),
        (ONE.replace('"ball"', '"bull"'), "objects[0].model: there is no [models.bull]"),
        (BALL + "[[objects]]\n", "objects[0]: the key 'model' is missing"),
        ("objects = 3\n" + BALL, "objects: expected a list"),
        (ONE + "position = [0, 0, nan]\n", "objects[0].position[2]: nan is not a finite number"),
        (ONE + 'position = [0, 0, "x"]\n', "objects[0].position[2]: expected a number, got a string"),
        (ONE + "position = [0, 0, 1" + "0" * 400 + "]\n", "objects[0].position[2]: number out of range"),
        (ONE + "rotation = { quaternion = [0, 0, 0, 2] }\n", "objects[0].rotation.quaternion: its norm is 2"),
        (ONE + "rotation = { axis = [0, 0, 0], degrees = 3 }\n", "objects[0].rotation.axis: a direction of no length"),
        (ONE + "rotation = { axis = [0, 0, 1] }\n", "objects[0].rotation: the key 'degrees' is missing"),
        (ONE + "lod = 1.5\n", "objects[0].lod: fraction"),
        (ONE + 'lod = "fine"\n', "objects[0].lod: LOD 'fine'"),
        (ONE + "lod = true\n", "objects[0].lod: expected a whole number or a number or a string or a list, got true"),
        (ONE + "world = -1\nworlds = 2\n", "objects[0].worlds"),
        (ONE + "collision_group = 4294967296\n", "objects[0].collision_group"),
        (ONE + "collision_mask = -1\n", "objects[0].collision_mask"),
        (ONE + "count = 1000\nworlds = 100000\n", "objects[0].worlds: more than"),
        (ONE + "grid = { size = [1000, 1000, 1000], spacing = [1, 1, 1] }\n", "objects[0].grid.size: more than"),
        (ONE + "count = 2\ngrid = { size = [1, 1, 1], spacing = [1, 1, 1] }\n", "give count or grid"),
        (ONE + "grid = { size = [0, 1, 1], spacing = [1, 1, 1] }\n", "give count or grid"),
        (ONE + "random = { wobble = 1 }\n", "objects[0].random.wobble: unknown key"),
        (SWEPT, "lod_sweep[0]: give one of model and objects"),
        (SWEPT + 'model = "x"\n', "lod_sweep[0].model"),
        (SWEPT + 'objects = ["x"]\n', "no object is named 'x'"),
        (SWEPT + 'model = "ball"\n[lod]\nbudget_ms = 1\n', "lod: LODs are swept, or chosen by a controller"),
        (ONE + "[picture]\neye = [0, 2, 0]\n", "picture.up: points along eye"),
        (ONE + "kinematic = true\n", "objects[0].kinematic: the scene has no [dynamics]"),
        (ONE + "density = 2\n[dynamics]\n", "objects[0].density: unknown key"),
        (ONE + "[dynamics]\nrestitution = 0.5\n", "dynamics.restitution: unknown key"),
        (ONE + "static = true\n[dynamics]\ncontinuous = true\n", "dynamics.continuous: no object is a rigid body"),
        (ONE + "static = true\nkinematic = true\n[dynamics]\n", "objects[0].kinematic: a static object"),
        (ONE + "shuttle = { by = [1, 0, 0], period = 1 }\n[dynamics]\n", "objects[0].shuttle: a rigid body"),
        (ONE + "[dynamics]\n[picture]\ntime = 1\n", "picture.time: rigid bodies"),
        (ONE + "[lod]\n", "lod: give budget_ms or tolerance"),
        (ONE + '[lod]\ncontroller = "magic"\n', "lod.controller: 'magic' is none of predictive, paper, tolerance"),
        (ONE + '[lod]\ncontroller = "paper"\n', "lod: controller 'paper' needs a budget"),
        (ONE + '[lod]\ncontroller = "paper"\nbudget_ms = 1\nspacing = "ratio"\n', "lod.spacing: the LODs"),
        (ONE + "[lod]\nbudget_ms = 1\nlow = 0.9\naim = 0.5\n", "lod.low: is above aim"),
        (FLAT + "[dynamics]\n", "scene.toml: objects: model 'm' is flat"),
        (LOOK, "camera: the key 'target' is missing"),
        (LOOK + "target = [0, 0, 1]\n", "camera: the camera looks at its own eye"),
        (LOOK + "target = [0, 0, 0]\nup = [0, 0, 0]\n", "camera.up: a direction of no length"),
        (LOOK + KEY, "camera: give eye and target, or"),
        (ONE + 2 * KEY, "camera.keys[1].time: 0.0 is not after"),
        # Numbers that overflow.
        (M.format('shape = "icosphere"\nradius = 1e308'), ""),
        (M.format('shape = "revolve"\nsections = 3\nprofile = [[1, -1e308], [1, 1e308]]'), ""),
        (M.format('shape = "icosphere"\nscale = 1e308\nradius = 1e9'), ""),
        (ONE + "count = 50\nposition = [1.7e308, 0, 0]\nrandom = { position = [1.7e308, 0, 0] }\n", ""),
        (ONE + "[scene]\ntime_step = 1e308\n", ""),
        (ONE + "[[lod_sweep]]\nmodel = 'ball'\nfrom = 1.0\nto = 0.5\nperiod = 1e-320\n", ""),
        (ONE + "[[lod_sweep]]\nmodel = 'ball'\nfrom = 1e-320\nto = 1.0\nperiod = 1.0\n", ""),
        (ONE + "[camera]\neye = [1e308, 0, 0]\ntarget = [-1e308, 0, 0]\n", ""),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_wrong_is_said(tmp_path, text, message):
    told = str(refused(SceneError, None, lambda: load(tmp_path, text).frame()))
    assert told.startswith(str(tmp_path / "scene.toml")) and message in told


def deep(count, value="1"):
    return ".".join(["a"] * count) + f" = {value}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ONE + deep(17), "objects[0].a.a.a"),
        (ONE + deep(5000), "line 6: a key nested more than 16 deep"),
        (ONE + "random." + deep(5000), "line 6: a key nested"),
        (ONE + "[" + deep(5000).replace(" = 1", "]"), "line 6: a key nested"),
        (ONE + "random = { " + deep(5000).strip() + " }", "line 6: a key nested"),
        (ONE + "# " + 5000 * "." + "\nlod = 0.5 # " + 5000 * "." + "\n" + deep(5000), "line 8: a key nested"),
        (ONE + "'#'." + deep(20), "line 6: a key nested"),
        (ONE + '[objects."a\'#".' + deep(20).replace(" = 1", "]"), "line 6: a key nested"),
        (ONE + 2**18 * "[a]\n", "the file: has more than 262,144 tables"),
        (ONE + "".join(f"{deep(16)}\n" for _ in range(2**15)), "the file: has more than 262,144 tables"),
        (ONE + "x = [" + 2**18 * "{}," + "]", "the file: has more than 262,144 tables"),
        (ONE + "position = [\n0,\n" + 5000 * "[" + 5000 * "]" + "]", "line 8: nested more than 16 deep"),
        (ONE + "x = " + 5000 * "{a=" + "1" + 5000 * "}", "line 6: nested more than 16 deep"),
        (ONE + 'model = "' + 10**6 * "x" + '"\n', "not valid TOML"),
        (ONE.replace('"ball"', '"' + 10**6 * "x" + '"'), "objects[0].model: there is no [models.xxx"),
        (ONE + 10**6 * "x" + " = 3", "xxx: unknown key"),
        (M.format('mesh = "' + 10**4 * "x" + '"'), "models.m.mesh: File name too long"),
        (ONE + "worlds = " + 400 * "9", "objects[0].worlds: expected a whole number <= 1000000"),
        (M.format('shape = "uv_sphere"\ncount = [10000, 10000]'), "models.m: asks for 400,160,016 faces; a file may"),
        (M.format('shape = "box"\nfaces = 2000000000'), "models.m: asks for 2,000,000,000 faces"),
        (M.format('shape = "box"\nfaces = 4000000'), "models.m: faces: Loop subdivision of 12 faces reaches 3,145,728"),
        (LARGE + ONE, "models.m3: asks for 1,310,720 faces, 5,242,880 with those of the models before"),
        (ONE + "count = 2\n" + ONE[len(BALL) :] + "worlds = 1000000\n", "objects[1].worlds: more than 1,000,000"),
        (ONE + "[picture]\nlods = " + str(100 * [0.5]), "picture.lods: expected a list of length <= 64"),
    ],
)
def test_what_is_too_much_is_refused_at_once(tmp_path, monkeypatch, text, message):
    """Before any mesh is made: the numbers are within the limits of their own keys."""
    for name in ("uv_sphere", "icosphere"):
        monkeypatch.setattr(trimesh.creation, name, lambda **_: pytest.fail("made"))
    told = str(refused(SceneError, None, load, tmp_path, text))
    assert told.startswith(str(tmp_path / "scene.toml")) and message in told and len(told) < 700


@pytest.mark.parametrize("title", ['"{}"', "'#{}'", '"""\n#" ""{}"""""', "'''\n\"#{}''''", '"#\\"{}"', "1.5 # '\"{}"])
def test_dots_of_strings_and_comments_are_no_keys(tmp_path, monkeypatch, title):
    monkeypatch.setattr(decode, "TABLE_LIMIT", 6)  # [models.ball], [[objects]] and what stands below
    key = "title" if "1.5" not in title else "time_step"
    load(tmp_path, ONE + f"velocity = [1.5, 2.5, 3.5]\n[scene]\n{key} = {title.format(40 * 'a.[')}\nseed = 3\n")


@pytest.mark.parametrize("case", LIMITS)
def test_a_file_is_limited_as_a_whole(tmp_path, monkeypatch, case):
    module, limit, value, good, bad, message = LIMITS[case]
    monkeypatch.setattr(module, limit, value)
    load(tmp_path, ONE + good)
    refused(SceneError, message, load, tmp_path, ONE + bad)


COUNTS = [{}, *({"count": [n, k]} for n, k in ((3, 3), (8, 5), (5, 8), (40, 31)))]
SECTIONS = [{}, {"sections": 3}, {"sections": 50}]
SIZES = {
    "box": [{}],
    "icosphere": [{}, {"subdivisions": 4}],
    **dict.fromkeys(("uv_sphere", "capsule"), COUNTS),
    **{key: [{"radius": 1, "height": 1, **n} for n in SECTIONS] for key in ("cylinder", "cone")},
    "annulus": [{"r_min": 1, "r_max": 2, "height": 1, **n} for n in SECTIONS],
    "torus": [
        {"major_radius": 1, "minor_radius": 0.3, **n}
        for n in ({}, *({"major_sections": n, "minor_sections": 7} for n in (3, 50)))
    ],
    "knot": [{"radius": 1, "tube_radius": 0.2, "sections": [50, 7]}],
    "terrain": [{"extents": [1, 1], "cells": [30, 7], "bumps": 0, "waves": 1, "rim": 0}],
    "bolt": [{"radius": 1, "length": 3, "pitch": 0.1, "head": 3, "sections": [20, 9]}],
    "nut": [{"radius": 1, "height": 3, "pitch": 0.1, "width": 3, "sections": [20, 9]}],
    "revolve": [{"profile": [[1, 0], [2, 1], [1, 4]], "sections": 9}],
}


@pytest.mark.parametrize("shape", SHAPES)
def test_faces_of_a_shape_are_known_before_it_is_made(tmp_path, shape):
    make = GENERATED.get(shape) or getattr(trimesh.creation, shape)
    for parameters in SIZES[shape]:
        mesh = make(**parameters)
        assert len(mesh.faces) <= FACE_BOUNDS[shape](**parameters) <= 1.5 * len(mesh.faces) + 100
    keys = "".join(f"{key} = {value}\n" for key, value in parameters.items())
    model = load(tmp_path, M.format(f'shape = "{shape}"\n{keys}')).models["m"]
    np.testing.assert_allclose(np.ptp(model.mesh_at(model.lod_max)[0], axis=0), mesh.extents)
