"""Bad arguments and files of every package: each refused by one line that names what is wrong."""

import json
import re
from functools import partial

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.questions import in_a_row
from helpers.samples import STILL, sample
from helpers.viewer import write_scene

import warp_abtree as ab
from warp_abtree.app import load_scene
from warp_abtree.app.cli.main import main
from warp_abtree.lod.timing import WorkClock
from warp_abtree.lod.view import Camera
from warp_abtree.model.mesh import load_mesh


def balls(device="cpu", count=2):
    return in_a_row(device, "small ball", 0.1 * np.arange(count))


def test_a_number_of_objects_is_whole_and_above_0(tmp_path):
    for count in (0, 1.5, "x", True, np.nan):
        refused(ValueError, r"^objects [^\n]*$", load_scene, write_scene(tmp_path), device="cpu", objects=count)
    loaded = load_scene(write_scene(tmp_path), device="cpu", objects=np.int64(5))
    assert loaded.scene.object_count == 5


def refuse(name, make, *values):
    """Yield calls of a maker by a name that must be in the error, one a bad value."""
    yield from ((name, lambda value=value: make(value)) for value in values)


def in_scene(output="any", **options):
    scene = balls()
    if output == "first_contact":
        return scene.first_contact([(0, 1)], scene.poses, **options)
    return scene.intersect([(0, 1)], output, **options)


def swept(output="any", **options):
    model, ends = balls().models[0], {"end_poses": [STILL]} if output == "first_contact" else {}
    return ab.sweep(model, model, [STILL], output=output, device="cpu", **{**ends, **options})


def refuse_options(ask, names, output, values):
    """Yield calls with a bad value of each of some options."""
    for name in names.split():
        yield from refuse(f"^{name}\\b", lambda x, name=name: ask(output, **{name: x}), *values)


NO_NUMBER, NO_FLAG = (False, True, "x", np.nan), (0, 1, "x", [True])
BAD_NUMBERS = ("8", None, np.nan, -1.0, [8.0])
REFUSED = [
    *refuse("time_step", lambda x: ab.Frame(balls(), time_step=x), 0, np.nan, "x"),
    *refuse("^output ", lambda x: ab.Frame(balls(), output=x), "everything", None, np.zeros(0)),
    *refuse("lods", lambda x: ab.Frame(balls(), lods=x), "paper", [0, 0]),
    *refuse("clock", lambda x: ab.Frame(balls(), clock=x), 3.0, "cpu"),
    *refuse("motion", lambda x: ab.Frame(balls(), motion=x), ab.Kinematic(np.zeros((99, 3)))),
    *refuse("rates: 'query'", lambda x: WorkClock({"query": x}), np.nan, -1e-9, "fast", [1.0, 2.0]),
    *refuse(r"^view: ", lambda x: Camera(np.zeros(3), x), np.eye(3) + 0j, np.diag([1.0, np.nan, 1.0]), np.eye(4), "x"),
    *refuse(r"^eye: ", lambda x: Camera(x, np.eye(3)), np.zeros(3) + 1j),
    *refuse(r"^budget_ms\b", lambda x: ab.PaperController(balls(), x), *BAD_NUMBERS),
    *refuse(r"^budget_ms\b", lambda x: ab.PredictiveController(balls(), x), *BAD_NUMBERS),
    *refuse(r"^tolerance\b", lambda x: ab.ToleranceController(balls(), x), *BAD_NUMBERS),
    *refuse(r"^threshold_ms\b", lambda x: ab.PaperController(balls(), 8.0, threshold_ms=x), "8", np.nan, -1.0),
    *refuse("^device 'cpu'", lambda x: balls().intersect(device=x), "cpu"),
    *refuse("^device 'cpu'", lambda x: balls().first_contact(None, np.eye(4)[None].repeat(2, 0), device=x), "cpu"),
    *refuse("^output ", in_scene, ["any"], 1, None),
    *refuse("^output ", swept, ["any"], 1, None),
    *refuse("^output ", lambda x: ab.Query(balls(), x), ["any"], np.zeros(0)),
    *refuse_options(in_scene, "precision", "any", (["exact"], np.zeros(0))),
    *refuse_options(in_scene, "precision", "distance", (["exact"], np.zeros(0))),
    *refuse("^sort_pairs ", lambda x: ab.Query(balls(), sort_pairs=x), *NO_FLAG),
    *refuse("^pairs: ", lambda x: ab.DistanceQuery(balls(), x), 1.5, 0),
    *refuse("^static ", lambda x: balls().change(0, static=x), [[True, False], [True]]),
    *refuse_options(in_scene, "within gap", "contacts", NO_NUMBER),
    *refuse_options(in_scene, "tolerance relative beyond", "distance", NO_NUMBER),
    *refuse_options(in_scene, "signed originals", "distance", NO_FLAG),
    *refuse_options(in_scene, "screw linear", "first_contact", NO_FLAG),
    *refuse_options(swept, "within", "any", NO_NUMBER),
    *refuse_options(swept, "tolerance relative beyond", "distance", NO_NUMBER),
    *refuse_options(swept, "signed originals", "distance", NO_FLAG),
    *refuse_options(swept, "screw linear", "first_contact", NO_FLAG),
    *refuse("^end_poses: ", lambda x: swept(output="first_contact", end_poses=x), False, "x"),
    *refuse("^orient ", lambda x: ab.Model.from_arrays(np.eye(3), [[0, 1, 2]], orient=x), *NO_FLAG, None),
    *refuse("^solid .*'closed'", lambda x: ab.scene_from_trimesh(trimesh.Scene(), solid=x), *NO_FLAG, None),
    *refuse("^device ", lambda x: ab.Query(balls(), "any").run(x), *NO_FLAG),
    *refuse("^device ", lambda x: ab.Query(balls(), "any").result(x), *NO_FLAG),
    *refuse("^dt\\b", lambda x: ab.Dynamics(balls()).launch(x), 0, -1, np.nan, np.inf, "x", None),
    *refuse("^velocity: ", lambda x: ab.Dynamics(balls(), velocity=x), "x", object(), 10**400),
    *refuse("^velocity: a number is not finite", lambda x: ab.Dynamics(balls(), velocity=x), (np.nan, 0, 0)),
    *refuse("^angular_velocity: shape", lambda x: ab.Dynamics(balls(), angular_velocity=x), (1, 2)),
    *refuse("^gravity", lambda x: ab.Dynamics(balls(), gravity=x), (0, 0, np.inf)),
    *refuse("^kinematic", lambda x: ab.Dynamics(balls(), kinematic=x), [[0], [0, 1]], [5], [True]),
    *refuse("^friction", lambda x: ab.Dynamics(balls(), friction=x), np.inf),
    *refuse("^friction -0.1 is below 0", lambda x: ab.Dynamics(balls(), friction=x), -0.1),
    *refuse("^capacity", lambda x: ab.Dynamics(balls(), capacity=x), 0),
    *refuse("^position: ", lambda x: ab.Kinematic(x), "x", object(), 10**400, [0.0, 0, 0]),
    *refuse("^velocity", lambda x: ab.Kinematic(np.zeros((3, 3)), velocity=x), np.zeros((2, 3)), [np.nan, 0, 0]),
    *refuse("^rotation", lambda x: ab.Kinematic(np.zeros((3, 3)), rotation=x), [0.0, 0, 0, 2]),
    *refuse("^axis", lambda x: ab.Kinematic(np.zeros((3, 3)), axis=x, rate=1.0), [0.0, 0, 0]),
    *refuse("^period", lambda x: ab.Kinematic(np.zeros((3, 3)), period=x), 0.0, np.nan),
    *refuse(
        "base_faces", lambda x: ab.Model.from_arrays(np.eye(3), [[0, 1, 2]], base_faces=x), 0, 1.5, np.inf, "ten", True
    ),
]


NO_SCENES = ab.Pipeline, ab.PoseInput, ab.Dynamics, ab.Frame, ab.ToleranceController, ab.PaperController
NO_SCENES += ab.PredictiveController, ab.to_trimesh, ab.Query, ab.ContactQuery, ab.ManifoldQuery, ab.DistanceQuery


@pytest.mark.parametrize("make", NO_SCENES)
def test_what_is_no_scene_is_named(make):
    for given in (None, "x", np.zeros(3), ab.Scene, sample("small ball")):
        refused(TypeError, "^scene: a Scene", make, given, *([8.0] if "Controller" in make.__name__ else []))


def test_other_types_are_named():
    manager, scene = ab.CollisionManager("cpu"), balls()
    for call, given, message in (
        (manager.first_contact_internal, None, "^transforms is a NoneType"),
        (manager.in_collision_other, [[]], "^other_manager is a list"),
        (manager.min_distance_other, [], "^other_manager is a list"),
        (partial(ab.to_trimesh, scene), "x", "^result: a Result"),
        (partial(ab.Frame, scene), object(), "^motion: a object"),
    ):
        refused(TypeError, message, call, given)


@pytest.mark.parametrize(("message", "call"), REFUSED)
def test_bad_arguments_are_named(message, call):
    with np.errstate(all="ignore"), pytest.raises(ValueError, match=message) as refusal:
        call()
    assert "\n" not in str(refusal.value)


def test_a_summary_is_of_frames(device):
    clock = WorkClock({"query": 0})  # a rate of work may be 0
    frame = ab.Frame(balls(device), output="contacts", clock=clock)
    refused(ValueError, "none has run", frame.summary)
    assert frame.step().contacts is not None
    assert frame.summary()["frames"] == 1 and clock.rates["query"] == 0


@pytest.mark.parametrize("index", [4, 2**31, -(10**30)])
@pytest.mark.parametrize("face", ["f 1 2 {}", "f 1 2 3 {}", "f {0}/1 2/1 3/1"])
def test_an_index_of_obj_beyond_the_vertices(tmp_path, index, face):
    path = tmp_path / "big.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + face.format(index) + "\n")
    refused(ab.MeshError, r"big\.obj: .*vert[^\n]*$", load_mesh, path)


def test_a_built_model_is_opened_not_loaded(tmp_path):
    path = tmp_path / "ball.npz"
    sample("small ball").save(path)
    for load in (ab.Model.load, load_mesh):
        refused(ab.MeshError, r"ball\.npz: .*Model\.open", load, path)


def test_info_reads_a_built_model(tmp_path, capsys):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [5, 5, 5]]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4", "f 1 5 6"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    model = ab.Model.load(tmp_path / "m.obj")
    model.save(tmp_path / "m.npz")
    found = {}
    for name in ("m.obj", "m.npz"):
        assert main(["info", str(tmp_path / name), "--json", "--device", "cpu"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    own = {"lods": model.lod_max + 1, "base_faces": len(model.mesh_at(0)[2])}
    of_file = ("parts", "file_vertices", "unreferenced_vertices", "welded_vertices")
    assert found["m.obj"]["dropped_faces"] == 1
    assert found["m.npz"] == {key: value for key, value in found["m.obj"].items() if key not in of_file} | own
    assert main(["info", str(tmp_path / "m.npz"), "--device", "cpu"]) == 0
    assert re.search(r"^lods +\d", capsys.readouterr().out, re.M)
