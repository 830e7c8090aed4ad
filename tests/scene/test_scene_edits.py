"""Editing a scene: names, poses of one object, objects removed and changed; what is left is a scene made anew."""

import copy
import csv
import gc
import pickle
import sys
import weakref

import numpy as np
import pytest
import trimesh
import warp as wp
from conftest import slow
from helpers import refused
from helpers.samples import STILL, random_poses, sample
from helpers.scenes import TURN, everything, pair_scene, scene_with
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warp_abtree as ab
from warp_abtree.interop.tape import record_pair_distance
from warp_abtree.model.mesh import MeshError
from warp_abtree.query.operator import Operator

MODELS = ("small ball", "box", "torus", "twins")
FLAGS = {"static": st.booleans(), "collision_group": st.integers(0, 3), "collision_mask": st.integers(0, 3)}
CHANGES = st.fixed_dictionaries({}, optional={**FLAGS, "world": st.integers(-1, 1), "name": st.sampled_from("xyz")})


def answers(scene):
    """Return what a scene answers about pairs of its objects, by their numbers among those that are there."""
    number = np.cumsum(scene.present) - 1
    pairs = scene.broad_phase()
    found = scene.intersect(pairs, output="count")
    objects = np.flatnonzero(scene.present).tolist()
    names = [scene.name(i) for i in objects if not scene.name(i).endswith(f" {i}")]
    return number[pairs].tolist(), found.count.tolist(), scene.lods[objects].tolist(), names


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_an_edited_scene_is_one_made_anew(device, data):
    """After any adds, removals and changes, but for the order of objects, which are told apart by their poses."""
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    scene, told = ab.Scene(device), {}
    for _ in range(data.draw(st.integers(3, 12))):
        act = data.draw(st.sampled_from(["add", "add", "add", "remove", "change", "pose", "ask"]))
        i = data.draw(st.sampled_from(sorted(told))) if told else None
        if act == "add" or i is None:
            model, pose = sample(data.draw(st.sampled_from(MODELS))), random_poses(rng, 1, 0.5)[0]
            place = scene.add(model, pose, lod=3)
            assert place == min(set(range(scene.object_count + 1)) - set(told))
            told[place] = {"model": model, "pose": pose, "lod": 3}
        elif act == "remove":
            scene.remove(i)
            del told[i]
        elif act == "change":
            change = data.draw(CHANGES)
            scene.change(i, **change)
            told[i] |= change
        elif act == "pose":
            told[i]["pose"] = random_poses(rng, 1, 0.5)[0]
            scene.set_pose(i, told[i]["pose"])
        else:
            scene.broad_phase()
    fresh = ab.Scene(device)
    for i in sorted(told):
        fresh.add(**told[i])
    assert np.flatnonzero(scene.present).tolist() == sorted(told)
    if told:
        assert answers(scene) == answers(fresh)
        assert np.array_equal(scene.poses[scene.present], fresh.poses)
        used = {id(each["model"]) for each in told.values()}
        assert {id(model) for model in scene.models if model.name != "removed"} == used


@pytest.mark.parametrize("pose", [random_poses(np.random.default_rng(2), 1, 2.0)[0], TURN])
def test_one_pose_is_set_as_all_are(device, pose):
    scenes = [pair_scene(device), pair_scene(device)]
    assert len(scenes[0].broad_phase()) == 2
    scenes[0].set_pose(1, pose)
    rows = [pose if i == 1 else row for i, row in enumerate(pair_scene(device).poses)]
    if np.ndim(pose) == 2:
        rows = [row if i == 1 else np.eye(4) for i, row in enumerate(rows)]
        for i, y in ((0, 0.0), (2, 0.5)):
            rows[i][1, 3] = y
    scenes[1].set_poses(np.array(rows))
    assert everything(scenes[0]) == everything(scenes[1])
    assert np.array_equal(scenes[0].broad_phase(), scenes[1].broad_phase())


def test_poses_are_read_back(device):
    """To rounding, with qw of 0 or more, whether objects have been used or not, and after what else changes."""
    poses = random_poses(np.random.default_rng(4), 5, 3.0)
    scene = ab.Scene(device)
    assert scene.poses.shape == (0, 7)
    scene.add_many(sample("box"), poses)
    poses *= np.where(poses[:, 6:] < 0, [1, 1, 1, -1, -1, -1, -1], 1)
    np.testing.assert_allclose(scene.poses, poses, rtol=0, atol=1e-15)
    scene.remove([1, 3])
    np.testing.assert_allclose(scene.poses, poses, rtol=0, atol=1e-15)


def test_what_is_removed_is_nowhere(device):
    scene = pair_scene(device)
    query = ab.Query(scene, "any", pairs=[(1, 2)])
    scene.remove(1)
    refused(RuntimeError, "removed", query.launch)
    assert scene.object_count == 3 and scene.present.tolist() == [True, False, True]
    scene.set_poses(scene.poses)
    before = everything(scene)
    calls = [(scene.intersect, [(0, 2), (2, 1)]), (scene.filter, [(1, 0)]), (scene.remove, [0, 1])]
    calls += [(scene.first_contact, [(1, 0)], scene.poses)]
    calls += [(scene.set_pose, 1, STILL), (scene.name, 1), (scene.tree_state, 1)]
    for call, *arguments in [*calls, (scene.change, 1, 0)]:
        refused(ValueError, "object 1.* removed", call, *arguments)
    refused(ValueError, "twice", scene.remove, [0, 0])
    refused(ValueError, "outside 0 .. 2", scene.remove, [0, 3])
    query = ab.Query(scene, "any", pairs=[(0, 2)])
    scene.remove([])
    query.launch()
    # Of a place without an object any LOD is one, in scenes and frames, and any pose.
    scene.set_lods([30, 10**6, 12])
    start, poses = scene.poses, scene.poses
    poses[1] = np.nan
    scene.set_poses(poses)
    scene.set_poses(wp.array(poses, dtype=wp.float64, device=device))
    ends = scene.poses + [9, 0, 0, 0, 0, 0, 0]
    times = scene.first_contact([(0, 2)], ends).time
    ends[1] = np.nan
    np.testing.assert_array_equal(scene.first_contact([(0, 2)], ends).time, times)
    ab.Frame(scene, type("Still", (list,), {"poses": lambda self, time, out: np.array(self)})(poses)).step()
    refused(ValueError, "pose 2 is not finite", scene.set_poses, poses[[0, 0, 1]])
    scene.set_poses(np.stack([np.eye(4), np.zeros((4, 4)), np.eye(4)]))
    scene.set_poses(start)
    ab.Frame(scene, lods=lambda _: np.array([30, -1, 12])).step()
    assert everything(scene) == before
    assert list(ab.to_trimesh(scene).graph.nodes_geometry) == ["small ball 0", "small ball 2"]
    # The filter of objects 0 and 1 went with object 1.
    assert scene.add(sample("box"), (0.5, 0.25, 0, 0, 0, 0, 1)) == 1
    assert [0, 1] in scene.broad_phase().tolist()


def launched(operator, poses=None, lods=None):
    """Launch an operator with poses and LODs written to its arrays, and raise what it finds wrong with them."""
    for array, values in ((operator.poses, poses), (getattr(operator, "lods", None), lods)):
        if values is not None:
            array.assign(values)
    operator.launch()
    operator.check()


def test_operators_read_nothing_of_places_without_an_object(device):
    scene = pair_scene(device)
    scene.remove(1)
    poses, nothing = scene.poses, np.array([np.zeros(3), [np.nan] * 3, np.zeros(3)])
    poses[1] = np.nan
    levels = [[0, model.lod_max] for model in scene.models]
    for options in ({}, {"groups": [0, 1, 0]}, {"ladder": levels}):
        wanted = [3, -7] if "groups" in options else [3, -7, 3]
        launched(ab.Pipeline(scene, **options), poses, wanted)
        for bad in (poses[[1, 0, 0]], None), (None, [-7, *wanted[1:]]):
            refused(ValueError, "0, and ", launched, ab.Pipeline(scene, **options), *bad)
    launched(ab.PoseInput(scene), poses)
    refused(ValueError, "object 2, and|object that had one is 2", launched, ab.PoseInput(scene), poses[[0, 0, 1]])
    bodies = ab.Dynamics(scene, velocity=nothing, angular_velocity=nothing, kinematic=[0])
    bodies.step(0.01, poses)
    assert np.isfinite(bodies.poses()).all()
    for bad in (np.nan, -1):
        ab.ContactQuery(scene, gap=[0.1, bad, 0.1]).run()
        refused(ValueError, "^gap: .* of object 2", ab.ContactQuery, scene, gap=[0.1, bad, bad])
    query, tape = ab.DistanceQuery(scene, [(0, 2)]), wp.Tape()
    for rows in (poses, np.where(np.isnan(poses[:, :1, None]), np.nan, np.eye(4))):
        given = wp.array(rows, dtype=wp.float64, requires_grad=True, device=device)
        distance = record_pair_distance(tape, query, given)
        tape.backward(grads={distance: wp.ones_like(distance)})
        assert np.isfinite(given.grad.numpy()).all() and not given.grad.numpy()[1].any()
        tape.reset()


@pytest.mark.parametrize("exponent", [-99, 0, 99])
def test_objects_of_any_size_can_be_removed(device, exponent):
    mesh = trimesh.creation.box()
    model = ab.Model.from_arrays(np.ldexp(mesh.vertices, exponent), mesh.faces)
    scene = scene_with(device, model, model, model)
    scene.remove(1)
    assert scene.broad_phase().tolist() == [[0, 2]] and scene.intersect().any.all()


EDITS = {
    "add": lambda scene: scene.add(sample("twins"), STILL, name="new"),
    "append": lambda scene: scene.add_many(sample("twins"), [STILL] * 3),
    "remove": lambda scene: scene.remove([0, 2]),
    "change": lambda scene: scene.change(0, world=1, static=True, name="other"),
}


@pytest.mark.parametrize("edit", ["add", "remove", *slow("append", "change")])
def test_an_edit_is_made_wholly_or_not_at_all(device, edit):
    """Whichever line of it an interruption comes before."""

    def make():
        scene = pair_scene(device)
        scene.remove(1)
        scene.add(sample("torus"), (0.2, 0, 0, 0, 0, 0, 1))
        scene.remove(scene.add(sample("box")))
        scene.filter([(0, 2)])
        scene.intersect()
        return scene

    def held(scene):
        names = [scene.name(i) for i in np.flatnonzero(scene.present)]
        # The other questions first: they have to take what an interruption left.
        return scene.intersect().pairs.tolist(), names, scene.present.tolist(), len(scene.models), everything(scene)

    def interrupt(left):
        scene, lines = make(), set()

        def trace(frame, event, _):
            if not frame.f_code.co_filename.endswith(("objects.py", "batch.py", "generation.py")):
                return None
            if event == "line":
                lines.add((frame.f_code, frame.f_lineno))
                if len(lines) > left:
                    sys.settrace(None)
                    raise KeyboardInterrupt
            return trace

        try:
            sys.settrace(trace)
            EDITS[edit](scene)
            return scene, True
        except KeyboardInterrupt:
            return scene, False
        finally:
            sys.settrace(None)

    before, after = make(), make()
    EDITS[edit](after)
    allowed = held(before), held(after)
    assert allowed[0] != allowed[1]
    for left in range(1000):
        scene, done = interrupt(left)
        assert held(scene) in allowed[done:]
        if done:
            break
    assert left > 20


def test_changes_are_those_of_add_and_leave_the_rest(device):
    scene = pair_scene(device)
    scene.change(1, world=3, importance=2, name="bolt 7")
    assert (scene.worlds[1], scene.object_importance[1], scene.name(1)) == (3, 2, "bolt 7")
    assert scene.name(0) == "small ball 0" and scene.object_solid == [False] * 3
    scene.change(0, solid=True)
    scene.change(1, importance=3)
    assert scene.object_solid[0] and scene.name(1) == "bolt 7"
    scene.add(sample("soup"))
    before = everything(scene)
    refused(MeshError, "closed", scene.change, 3, solid=True, importance=2)
    refused(ValueError, "importance", scene.change, 0, importance=4, world=1)
    refused(ValueError, "name", scene.change, 0, name="")
    refused(ValueError, "name", scene.add, sample("box"), name=7)
    refused(ValueError, "names: 1 given for 2", scene.add_many, sample("box"), [STILL] * 2, names=["a"])
    for names in ("ab", 5):
        refused(ValueError, f"names: {names!r} is no list", scene.add_many, sample("box"), [STILL] * 2, names=names)
    assert everything(scene) == before and scene.object_importance == [1, 3, 1, 1]
    # A new name leaves queries as they are.
    query = ab.Query(scene, "any", pairs=[(0, 1)])
    scene.change(0, name="nut")
    query.launch()
    refused(ValueError, None, scene.add, sample("box"), lod=-1)
    query.launch()
    scene.change(0, static=True)
    refused(RuntimeError, "changed", query.launch)
    query = ab.Query(scene, "any", pairs=[(0, 1)])
    scene.add(sample("box"))
    refused(RuntimeError, "make a new one", query.launch)


def test_an_edit_gives_all_memory_back_at_once(device):
    """No operator, tree state or broad phase waits for the garbage collector, nor do operators of one's own."""
    scene = pair_scene(device)
    for output in ("any", "faces", "contacts", "distance"):
        scene.intersect(output=output, **({} if output == "distance" else {"within": 0.1}))
    scene.intersect([(0, 1)], "distance", originals=True)
    scene.first_contact(None, scene.poses)
    gc.collect()  # operators that other tests have refused
    made, batch = [part for part in gc.get_objects() if issubclass(type(part), Operator)], scene.batch()
    alive = [weakref.ref(part) for part in made if part.batch is batch]
    del made, batch
    alive += [weakref.ref(scene.batch()), weakref.ref(scene.batch().states)]
    gc.collect()
    gc.disable()
    try:
        assert len(alive) == 7
        scene.add(sample("box"))
        assert not [ref() for ref in alive if ref() is not None]
        query = ab.ManifoldQuery(scene, gap=0.1, remember=0.01)
        query.run()
        (ref, query) = weakref.ref(query), None
        assert ref() is None
    finally:
        gc.enable()


def test_a_pickled_result_holds_the_names_of_its_objects(device):
    scene = ab.Scene(device)
    scene.add_many([sample("box")] * 2000, np.tile(STILL, (2000, 1)), worlds=np.arange(2000) // 2)
    result = scene.intersect([(1, 0), (3, 1900)])
    for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert again.rows() == result.rows() and again.rows()[1]["second"] == "box 1900"
        again.check()
    assert len(pickle.dumps(result)) < 4000


def test_results_are_rows_with_names(device, tmp_path):
    scene, pairs, names = pair_scene(device), [(1, 2), (0, 1)], ["small ball 0", "nut, M20", "small ball 2"]
    scene.change(1, name=names[1])
    for output in ("any", "contacts", "distance", "first_contact"):
        ask = scene.first_contact if output == "first_contact" else scene.intersect
        asked = scene.poses if output == "first_contact" else output
        first, last = ask(pairs, asked), ask(pairs, asked, device=True)
        rows = first.rows()
        scene.change(1, name="other")
        assert rows == first.rows() == last.rows()
        scene.change(1, name=names[1])
        assert [(row["first"], row["second"]) for row in rows] == [(names[i], names[j]) for i, j in pairs]
        for name in ("any", "distance", "points", "clear", "count"):
            values = getattr(first, name)
            assert [row.get(name) for row in rows] == ([None] * 2 if values is None else values.tolist())
        first.to_csv(tmp_path / "rows.csv")
        with open(tmp_path / "rows.csv", newline="", encoding="utf-8") as file:
            table = list(csv.DictReader(file))
        assert [row["first"] for row in table] == [row["first"] for row in rows]
        if output == "contacts":
            point = [[float(row[f"point_{axis}"]) for axis in "xyz"] for row in table]
            np.testing.assert_array_equal(point, first.pair_contacts["point"])
        # Without a pair too, the table has these columns.
        none = ask([], asked, device=output == "any")
        none.to_csv(tmp_path / "none.csv")
        assert none.rows() == []
        with open(tmp_path / "none.csv", newline="", encoding="utf-8") as file:
            assert list(csv.reader(file)) == [list(table[0])]
