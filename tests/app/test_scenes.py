"""The scenes of the project at small sizes, generated shapes, controllers from files, and recorded runs."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.samples import true_faces
from helpers.viewer import write_scene
from msgspec import convert, toml

import warp_abtree as ab
from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.toml.models import GENERATED
from warp_abtree.app.toml.tables import AnyShape
from warp_abtree.lod.timing import WorkClock

SCENES = Path(__file__).resolve().parents[2] / "scenes"
# A machine so slow that few objects are a load.
RATES = {"node_test": 1e-7, "triangle_test": 2e-7}
CAMERA = """
[camera]
far = 20
keys = [{ eye = [0, 0, 9], target = [0, 0, 0] }, { time = 0.5, eye = [2, 0, 0], target = [0, 0, -9] }]
"""
CONTROL = """
lod = { controller = "predictive", budget_ms = 4, tolerance = 0.02 }
"""
RINGS = """
scene = { frames = 8, time_step = 0.1 }
models.ring = { shape = "torus", major_radius = 0.6, minor_radius = 0.2, base_faces = 40 }
[[objects]]
model = "ring"
count = 24
grid = { size = [2, 3, 0], spacing = [0.9, 0.9, -0.9] }
shuttle = { by = [0.5, 0.1, 0.2], period = 1 }
random = { rotation = true, turn = 200, phase = true }
"""
STEERED = CONTROL + RINGS + CAMERA
BODIES = (
    "dynamics = { gravity = [0, -1, 0], friction = 0.25 }"
    + RINGS.replace("shuttle = { by = [0.5, 0.1, 0.2], period = 1 }", "velocity = [0, 0, 1]").replace(
        ", phase = true", ""
    )
    + """
[[objects]]
model = "ring"
kinematic = true
position = [0, 0, 4]
shuttle = { by = [0, 0, -4], period = 1 }
[[objects]]
model = "ring"
static = true
position = [0, -3, 0]
"""
)
BALL = 'models.ball = { shape = "icosphere", subdivisions = 0 }\n'
ROW = '[[objects]]\nmodel = "ball"\n'


def load(tmp_path, text, **options):
    return load_scene(write_scene(tmp_path, text), **{"device": "cpu", **options})


def load_ours(name, device, changes=(), **options):
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return load_scene(SCENES / f"{name}.toml", device=device, text=text, **options)


@pytest.mark.parametrize(
    ("text", "faces", "volume"),
    [
        # Pappus: a tube's volume is that of its section times the way of its middle, here a trefoil's.
        ('shape = "knot"\nradius = 3\ntube_radius = 0.1\nsections = [600, 60]', 72_000, None),
        ('shape = "revolve"\nprofile = [[1, 0], [1, 2]]\nsections = 500', 2000, 2 * math.pi),
        ('shape = "revolve"\nprofile = [[1, 0], [2, 3]]\nsections = 500', 2000, 7 * math.pi),
        # Half of a thread's depth is cut away on average: the square of the radius averages r^2 - r d + d^2 / 3.
        (
            'shape = "bolt"\nradius = 1\nlength = 4\npitch = 0.4\nhead = 3\nsections = [240, 400]',
            192_960,
            math.pi * 4 * (1 - 0.2 + 0.04 / 3) + 0.6 * 9 * math.sqrt(3) / 2,
        ),
        (
            'shape = "nut"\nradius = 1\nheight = 2\npitch = 0.4\nwidth = 3\nsections = [240, 200]',
            96_960,
            2 * 9 * math.sqrt(3) / 2 - 2 * math.pi * (1.04**2 - 1.04 * 0.2 + 0.04 / 3),
        ),
    ],
)
def test_generated_solids(tmp_path, text, faces, volume):
    table = convert(toml.decode(text), AnyShape)
    mesh = GENERATED[table.__struct_config__.tag](**table.parameters())
    assert len(mesh.faces) == faces and mesh.is_volume
    if volume is None:
        u = np.linspace(0, 2 * np.pi, 100_001)
        way = np.stack([(np.cos(3 * u) + 2) * np.cos(2 * u), (np.cos(3 * u) + 2) * np.sin(2 * u), -np.sin(3 * u)], 1)
        volume = math.pi * 0.1**2 * np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert mesh.volume == pytest.approx(volume, rel=0.01)


def test_faces_are_brought_to_a_number_and_shapes_stand_in_for_meshes(tmp_path):
    sizes = {"fewer": 200, "more": 1500, "odd": 201}
    text = "".join(f'models.{n} = {{ shape = "icosphere", subdivisions = 2, faces = {f} }}\n' for n, f in sizes.items())
    models = load(tmp_path, text + '[[objects]]\nmodel = "odd"\n').models
    assert [model.face_count for model in models.values()] == [200, 1500, 200]
    for model in models.values():
        assert 0.9 < np.linalg.norm(model.mesh_at(model.lod_max)[0], axis=1).mean() < 1.01
    text = '[models.m]\nmesh = ["gone.obj", "box.obj"]\nshape = "icosphere"\n[[objects]]\nmodel = "m"\n'
    for name, faces in (("m (an icosphere)", 1280), ("m (box.obj)", 12)):
        model = load(tmp_path, text).models["m"]
        assert (model.name, model.face_count) == (name, faces)
        trimesh.creation.box().export(tmp_path / "box.obj")
    text = text.replace('"box.obj"', '"gone.obj"').replace('shape = "icosphere"\n', "")
    refused(SceneError, r"gone.obj: no such file", load, tmp_path, text)


def test_another_number_of_objects(tmp_path):
    text = BALL + ROW + "count = 2\nworlds = 30\n" + ROW + "worlds = 30\n" + ROW + "count = 10\n" + ROW
    for asked, worlds, count in ((None, 30, 10), (51, 15, 5), (201, 60, 20), (1, 1, 1)):
        loaded = load(tmp_path, text, objects=asked)
        assert loaded.scene.object_count == 3 * worlds + count + 1
        assert loaded.worlds.max() == worlds - 1
    text = BALL + ROW + "grid = { size = [2, 2, 2], spacing = [1, 1, 1] }\n"
    refused(SceneError, "count or worlds", load, tmp_path, text, objects=3)
    # A grid grows with the number of objects.
    text = BALL + ROW + "count = 7\nposition = [0, 10, 0]\ngrid = { size = [2, 0, 1], spacing = [1, 3, 1] }\n"
    expected = [[x, 10 + y, 0] for y in (0, 3, 6, 9) for x in (-0.5, 0.5)][:7]
    assert np.allclose(load(tmp_path, text).motion.position, expected)
    assert load(tmp_path, text, objects=3).motion.position.tolist() == expected[:3]


def test_camera_goes_along_its_key_points(tmp_path):
    camera = load(tmp_path, STEERED).camera
    key_points = (-1, [0, 0, 9], [0, 0, 0]), (0.25, [1, 0, 4.5], [0, 0, -4.5]), (9, [2, 0, 0], [0, 0, -9])
    for time, eye, target in key_points:
        found = camera(time)
        back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
        assert np.allclose(found.eye, eye) and np.allclose(found.view[2], back) and found.far == 20
    assert np.allclose(load(tmp_path, STEERED + "loop = true").camera(1.75).eye, [1, 0, 4.5])
    assert load(tmp_path, RINGS).camera is None


def test_controllers_of_a_file(tmp_path):
    more = 'tolerance = 0.02, spacing = "ratio", steps = 1, aim = 0.8, low = 0.5'
    loaded = load(tmp_path, STEERED.replace("tolerance = 0.02", more))
    frame = loaded.frame()
    assert isinstance(frame.lods, ab.PredictiveController) and frame.lods.budget_ms == 4
    assert isinstance(loaded.frame(controller="paper").lods, ab.PaperController), "which has no spacing"
    assert loaded.frame(budget_ms=9).lods.budget_ms == 9
    tolerant = loaded.frame(controller="tolerance")
    assert isinstance(tolerant.lods, ab.ToleranceController)
    assert tolerant.run(3)[-1].budget_ms is None
    top = loaded.models["ring"].lod_max
    assert np.unique(loaded.scene.lods).tolist() == [top], "a ladder of one step"
    fine = load(tmp_path, STEERED).frame(controller="tolerance")
    assert fine.run(3)[-1].error_max > 0 and fine.scene.lods.max() < top
    off = loaded.frame(controller="none")
    assert off.lods is None and off.run(1)[0].error_max == 0
    plain = load(tmp_path, RINGS)
    assert isinstance(plain.frame(budget_ms=3).lods, ab.PredictiveController)
    for source, asked, message in (
        (loaded, {"controller": "tolerance", "budget_ms": 3}, "holds no budget"),
        (loaded, {"controller": "none", "budget_ms": 3}, "holds no budget"),
        (plain, {"controller": "paper"}, "needs a budget"),
        (plain, {"controller": "tolerance"}, "needs lod.tolerance"),
        (plain, {"controller": "x"}, "none of"),
    ):
        refused(ValueError, message, source.frame, **asked)


@pytest.mark.slow
def test_near_objects_refine(tmp_path, device):
    """With counted work in the place of time: at one budget, errors rise with the distance from the camera."""
    loaded = load_ours("focus", device, [("size = [10, 5, 0]", "size = [2, 2, 0]")], objects=80)
    finest = loaded.frame(controller="none", clock=WorkClock(RATES)).run(1)[0].total_ms
    frame = loaded.frame(budget_ms=finest / 3, clock=WorkClock(RATES))
    frame.run(90)
    time = frame.history[-1].time
    away = np.linalg.norm(loaded.motion.poses(time)[:, :3] - loaded.camera(time).eye, axis=1)
    models = np.take(np.array(loaded.scene.models, object), loaded.scene.object_model)
    error = np.array([model.error_at(int(lod)) for model, lod in zip(models, loaded.scene.lods)])
    near = away < np.median(away)
    assert 0 < error[near].mean() < 0.9 * error[~near].mean()
    assert frame.summary()["budget"]["within_110_percent"] >= 0.95
    assert loaded.camera(8.0).eye[2] < loaded.motion.position[:, 2].min(), "the camera comes out behind the field"
    again = loaded.frame(budget_ms=finest / 3, clock=WorkClock(RATES))
    assert np.array_equal(loaded.scene.batch().objects.pool.position.numpy(), loaded.motion.poses(0.0)[:, :3])
    assert [row.error_mean for row in again.run(12)] == [row.error_mean for row in frame.history[:12]]


def test_rigid_bodies_of_a_file(tmp_path, device):
    loaded = load(tmp_path, BODIES, device=device)
    bodies = loaded.make_bodies()
    assert bodies.mass[0] == pytest.approx(2 * math.pi**2 * 0.6 * 0.2**2, rel=0.05)
    assert loaded.models["ring"].face_count == 2048
    assert np.flatnonzero(~bodies.rigid).tolist() == [24, 25]
    assert bodies.kinematic.tolist() == [False] * 24 + [True, False]
    velocity, angular_velocity = bodies.velocities()
    assert np.allclose(velocity[:24], [0, 0, 1]) and np.allclose(velocity[24:], 0)
    assert 1 < np.linalg.norm(angular_velocity[:24], axis=1).max() <= math.radians(200)
    frame, start = loaded.frame(controller="none", bodies=bodies), bodies.poses()
    hits, poses = [row.hits for row in frame.run(4)], bodies.poses()
    # Three tenths of a second and one more: the driven one follows the shuttle, the static one stays, others fall.
    assert np.allclose(poses[24, :3], loaded.motion.poses(0.4)[24, :3]) and np.array_equal(poses[25], start[25])
    assert poses[:24, 1].mean() < start[:24, 1].mean()
    assert np.array_equal(loaded.make_bodies().poses(), start)
    assert [row.hits for row in loaded.frame(controller="none").run(4)] == hits, "a run begins at the start"


def test_hammered_nuts_stay_on_their_thread(device):
    """The rings arrive in the third step; where a nut is off the thread's helix it has passed through."""
    loaded = load_ours("nut_and_bolt", device, [("worlds = 8", "worlds = 1")])
    frame = loaded.frame()
    dynamics, nut = frame.motion.dynamics, 1
    assert len(dynamics.mass) == 5 and not loaded.scene.intersect(loaded.scene.broad_phase(), output="any").any.any()
    start = dynamics.poses()[nut]
    for _ in range(8):
        frame.step()
        assert dynamics.certified.pair_totals()["touching"] == 0
    pose = dynamics.poses()[nut]
    assert abs(pose[2] - start[2]) < 0.03 and abs(pose[5]) < 0.05 and np.abs(pose[:2]).max() < 0.03
    assert dynamics.poses()[2:, 2].min() > pose[2] + 0.3, "and no ring has passed the nut"


@pytest.mark.parametrize(
    ("name", "objects", "frames", "each", "size"),
    [("bunny_tori", None, 3, 6, 1), ("herd", None, 1, 200, 16), ("worlds", 16, 1, 16, 8)],
)
def test_scenes_of_the_project_intersect(device, name, objects, frames, each, size):
    if name != "worlds":
        pytest.importorskip("pxr")
    loaded = load_ours(name, device, objects=objects)
    frame = loaded.frame(output="any")
    frame.run(frames - 1)
    result = frame.step()
    assert loaded.scene.object_count >= each and len(np.unique(loaded.worlds)) >= size
    assert all(0 < row.intersecting for row in frame.history) and result.any.any()
    assert np.array_equal(loaded.worlds[result.pairs[:, 0]], loaded.worlds[result.pairs[:, 1]])


def test_needle(device):
    loaded = load_ours("needle", device)
    rows = loaded.frame().run(3)
    assert all(row.hits > 0 for row in rows)
    scene = loaded.scene
    result = scene.intersect(output="faces")
    meets = dict(zip(map(tuple, result.pairs.tolist()), result.any.tolist()))
    boxes = np.flatnonzero(loaded.worlds == 4)
    middle = boxes[0]
    assert [meets.get((middle, other), False) for other in boxes[1:]] == [True, True, True, False]
    # Exact brute force on the slivers, the far ones and the tiny ones of this frame.
    poses = loaded.motion.poses(2 * loaded.time_step)
    checked = 0
    for p, (i, j) in enumerate(result.pairs.tolist()):
        a, b = (scene.models[scene.object_model[k]] for k in (i, j))
        if a.face_count * b.face_count <= 110_000:
            expected = true_faces(a, a.lod_max, poses[i], b, b.lod_max, poses[j])
            np.testing.assert_array_equal(result.faces[result.faces[:, 0] == p, 1:], expected)
            checked += 1
    assert checked >= 12


def test_table1_stands_at_the_face_counts_of_the_paper(device):
    small = [("warp:", "none/"), ("\nfaces = 57563\n", "\nfaces = 1001\n"), ("[600, 60]", "[80, 10]")]
    loaded = load_ours("table1", device, [*small, *(2 * [line] for line in ("\nfaces = 4204\n", "\nfaces = 5804\n"))])
    models = [loaded.models[name] for name in ("bones", "cow", "bunny")]
    assert [model.face_count for model in models] == [4204, 5804, 1000] and models[1].name == "cow (a knot)"
    assert [len(model.mesh_at(0)[1]) for model in models] == [10, 10, 500]
    rows = loaded.frame().run(8)
    assert rows[0].faces == 4204 + 5804 + 1000 and rows[7].faces < rows[0].faces and rows[0].hits > 0
