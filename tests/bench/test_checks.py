"""The checks of benchmarks notice wrong answers."""

import numpy as np
import pytest

import warp_abtree as ab
from bench.cases import query, scale, sweep, update
from bench.meshes import knot_model
from bench.shapes import pair_poses, random_poses, scene_of_objects, scene_of_pairs
from bench.verify import count_differences
from warp_abtree import testing
from warp_abtree.state import work_lists

pytestmark = pytest.mark.slow


def test_differences_are_counted():
    truth = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 0]])
    assert count_differences(truth, truth) == (0, 0)
    assert count_differences([[0, 1, 2], [0, 2, 2], [1, 0, 1], [1, 0, 0]], truth) == (1, 2)
    assert count_differences(np.empty((0, 3)), truth) == (3, 0)


def check_baseline(scene, theirs, ours):
    return query.check_baseline(theirs, ours, scene.models[0], pair_poses(3, 0.2))


def lose_a_hit(scene, result):
    result.faces = result.faces[:-1]
    scale.check_alone(scene, result, result.pairs[2:])


def time_another_count(scene, result):
    result.count[1] += 1
    scale.time_query(ab.Query(scene, "faces", pairs=result.pairs), {}, result, 1)


def invent_a_pair(scene, result):
    taken = set(map(tuple, result.faces.tolist()))
    apart = next((0, 0, b) for b in range(300) if (0, 0, b) not in taken)
    check_baseline(scene, result.faces, np.concatenate([result.faces, [apart]]))


def sweep_otherwise(scene, result):
    poses = random_poses(2.0, 20).astype(np.float32)
    found = ab.sweep(scene.models[0], scene.models[0], poses, device=scene.device)
    sweep.check_sweep(scene.device, scene.models[0], poses, found)
    sweep.check_sweep(scene.device, scene.models[0], poses, ~found)


FAULTS = {
    lose_a_hit: "by themselves have other face pairs",
    time_another_count: "differs from the checked one",
    lambda scene, result: check_baseline(scene, result.faces, result.faces[1:]): "1 of 1 face pairs",
    invent_a_pair: "1 of 1 face pairs",
    sweep_otherwise: "the sweep and the query differ",
}


def test_a_wrong_answer_is_noticed(device):
    scene, pairs = scene_of_pairs(device, knot_model(300), pair_poses(3, 0.2))
    for fault, message in FAULTS.items():
        result = scene.intersect(pairs, "faces")
        scale.check_alone(scene, result, result.pairs)
        row = check_baseline(scene, result.faces[1:], result.faces)
        assert (row["judged"], row["ours_wrong"], row["peer_missed"]) == (1, 0, 1)
        with pytest.raises(RuntimeError, match=message):
            fault(scene, result)


def test_worlds_alone_notice_a_lost_hit(device):
    scene = scene_of_objects(device, knot_model(200), random_poses(0.5, 9), 3)
    result = scene.intersect(output="faces")
    scale.check_worlds(scene, result, 3, 3)
    result.faces = np.delete(result.faces, 0, axis=0)
    with pytest.raises(RuntimeError, match="by themselves"):
        scale.check_worlds(scene, result, 3, 3)
    result.pairs = result.pairs + [[0, 3]]
    with pytest.raises(RuntimeError, match="different worlds"):
        scale.check_worlds(scene, result, 3, 3)


def test_an_update_that_forgets_nodes_is_noticed(device, monkeypatch):
    model = knot_model(300)
    with testing.regime(block_updates=False):
        run_forgetting(device, monkeypatch, model)


def run_forgetting(device, monkeypatch, model):
    scene = ab.Scene(device)
    scene.add(model)
    move = scene, [model.lod_max - 5], [model.lod_max], model.face_count
    k, *_, launches = update.check_update(*move)
    assert k[0] > 0 and set(launches) == {"update", "full"}
    whole = work_lists.active_update

    def forget(models, states, work):
        if work.full.all():
            return whole(models, states, work)
        work_lists.active_mark(models, states, work)
        counts = work.plan.level_count.numpy().copy()
        counts[: len(work.level_room) - 2] = 0  # a partial update refits but its leaves
        work.plan.level_count.assign(counts)
        work_lists.active_walk(models, states, work)

    monkeypatch.setattr(work_lists, "active_update", forget)
    with pytest.raises(RuntimeError, match="bits"):
        update.check_update(*move)
