"""The checks of benchmarks notice wrong answers."""

import numpy as np
import pytest

import warp_abtree as ab
from bench.cases import build, query, scale, scaling, sweep, update
from bench.meshes import knot_model
from bench.shapes import pair_poses, random_poses, scene_of_pairs, scene_of_worlds, world_poses
from bench.verify import count_differences
from warp_abtree.state import lod_update, work_lists

pytestmark = pytest.mark.slow


@pytest.fixture
def posed(device):
    """A scene of 3 pairs of knots and all their face pairs."""
    scene, pairs = scene_of_pairs(device, knot_model(300), pair_poses(3, 0.2))
    return scene, scene.intersect(pairs, "faces")


def test_differences_are_counted():
    truth = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 0]])
    assert count_differences(truth, truth) == (0, 0)
    assert count_differences([[0, 1, 2], [0, 2, 2], [1, 0, 1], [1, 0, 0]], truth) == (1, 2)
    assert count_differences(np.empty((0, 3)), truth) == (3, 0)


def lose_a_hit(scene, result):
    result.faces = np.delete(result.faces, -1, axis=0)
    scale.check_alone(scene, result, result.pairs[2:])


def time_another_count(scene, result):
    timed = ab.Query(scene, "faces", pairs=result.pairs)
    result.count[1] += 1
    scale.time_query(timed, {}, result, 1)


def miss_a_pair(scene, result):
    query.check_baseline(result.faces, result.faces[1:], scene.models[0], pair_poses(3, 0.2))


def invent_a_pair(scene, result):
    taken = set(map(tuple, result.faces.tolist()))
    apart = next((0, 0, b) for b in range(300) if (0, 0, b) not in taken)
    ours = np.concatenate([result.faces, [apart]])
    query.check_baseline(result.faces, ours, scene.models[0], pair_poses(3, 0.2))


def sweep_otherwise(scene, result):
    poses = random_poses(20, 2.0).astype(np.float32)
    found = ab.sweep(scene.models[0], scene.models[0], poses, device=scene.device)
    sweep.check_sweep(scene.device, scene.models[0], poses, found)
    sweep.check_sweep(scene.device, scene.models[0], poses, ~found)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lose_a_hit, "by themselves have other face pairs"),
        (time_another_count, "differs from the checked one"),
        (miss_a_pair, "1 of 1 face pairs"),
        (invent_a_pair, "1 of 1 face pairs"),
        (sweep_otherwise, "the sweep and the query differ"),
    ],
)
def test_a_wrong_answer_is_noticed(posed, fault, message):
    with pytest.raises(RuntimeError, match=message):
        fault(*posed)


def test_right_answers_pass(posed):
    scene, result = posed
    scale.check_alone(scene, result, result.pairs)
    row = query.check_baseline(result.faces[1:], result.faces, scene.models[0], pair_poses(3, 0.2))
    assert (row["judged"], row["ours_wrong"], row["peer_missed"]) == (1, 0, 1)


def test_worlds_alone_notice_a_lost_hit(device):
    scene = scene_of_worlds(device, knot_model(200), world_poses(3, 3, 1.0))
    result = scene.intersect(output="faces")
    scale.check_worlds(scene, result, 3, 3)
    result.faces = np.delete(result.faces, 0, axis=0)
    with pytest.raises(RuntimeError, match="by themselves"):
        scale.check_worlds(scene, result, 3, 3)
    result.pairs = result.pairs + [[0, 3]]
    with pytest.raises(RuntimeError, match="different worlds"):
        scale.check_worlds(scene, result, 3, 3)


def test_frames_that_answer_otherwise_are_noticed(device, monkeypatch):
    whole = scaling.WorldFrames.answer
    monkeypatch.setattr(scaling.WorldFrames, "answer", lambda self, rows: whole(self, rows)[:-1])
    with pytest.raises(RuntimeError, match="frames: 2 devices answer otherwise than one"):
        list(scaling.run(device, f"{device},{device}", quick=True))


def test_a_model_whose_error_is_too_small_is_noticed(monkeypatch):
    model = knot_model(600)
    assert build.check_model(model, 100) >= 1
    monkeypatch.setattr(ab.Model, "error_at", lambda self, lod, kept=ab.Model.error_at: 0.5 * kept(self, lod))
    with pytest.raises(RuntimeError, match="beyond its error"):
        build.check_model(model, 1000)


def moved_scene(device, splits):
    """Return a scene of one knot, LODs some splits below its finest and the finest, and its number of faces."""
    model = knot_model(300)
    scene = ab.Scene(device)
    scene.add(model)
    return scene, [model.lod_max - splits], [model.lod_max], model.face_count


def test_an_update_that_forgets_nodes_is_noticed(device, monkeypatch):
    scene, there, back, faces = moved_scene(device, 5)
    k, *_, launches = update.check_update(scene, there, back, faces)
    assert k[0] > 0 and set(launches) == {"update", "full"}
    whole = lod_update.active_update

    def forget(models, states, work):
        if work.full.all():
            return whole(models, states, work)
        work_lists.active_mark(models, states, work)
        counts = work.plan.level_count.numpy().copy()
        counts[: len(work.level_room) - 2] = 0  # a partial update refits but its leaves
        work.plan.level_count.assign(counts)
        work_lists.active_walk(models, states, work)

    monkeypatch.setattr(lod_update, "active_update", forget)
    with pytest.raises(RuntimeError, match="bits"):
        update.check_update(scene, there, back, faces)
