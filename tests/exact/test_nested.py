"""Nested parts on the CPU: slabs of subtrees prune no pair that touches, and every answer stays the same."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.nested import nested_cases, touching_soups
from helpers.questions import pairs_of, scene_of
from helpers.samples import model_of_faces, random_poses, sample, true_faces
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.search import descent
from warp_abtree.kernels.search.item import first_item, item_first, item_second

wp.set_module_options(native.options("search/open_subtrees.h", "search/subtrees.h"))

CPU = "cpu"
AT_ONCE = 100  # leaf pairs that a test waits for


@pytest.mark.parametrize("gap", [0.001, 0.02, 0.06])
def test_nested_parts_equal_brute_force(device, gap):
    """With slabs of subtrees on the CPU, and of nodes of few faces where warps compare, as with boxes alone."""
    cases = nested_cases(np.random.default_rng(5), gap)
    truth = [true_faces(*case) for case in cases]
    rows = np.concatenate([np.insert(faces, 0, p, 1) for p, faces in enumerate(truth)])
    regimes = [{"warps": True, "warps_per_pair": 1, "slabs": slabs} for slabs in (True, False)]
    regimes += [{"plain_tests": count} for count in (0, 1000, 10**9)] if device == CPU else []
    tests = []
    for regime in regimes:
        with testing.regime(**regime):
            scene = scene_of(device, cases)
            found = scene.intersect(pairs_of(cases), "faces")
            met = scene.intersect(pairs_of(cases), "any").any
        np.testing.assert_array_equal(found.faces, rows)
        np.testing.assert_array_equal(met, [len(faces) > 0 for faces in truth])
        tests.append(np.stack([found.node_tests, found.triangle_tests], 1))
    with_slabs, plain, *on_cpu = tests
    np.testing.assert_array_equal(with_slabs[1], plain[1], "no slabs at coarse LODs")
    assert 1.03 * with_slabs[0, 1] < plain[0, 1], "slabs separate what boxes do not"
    assert not on_cpu or (1.3 * on_cpu[0].sum(0) < on_cpu[2].sum(0)).all()


def test_many_subtrees_share_little_memory(monkeypatch):
    """A tree of more subtrees than there is room for; the thread fills slots anew."""
    fine = ab.Model.load(trimesh.creation.torus(1.0, 0.35, 96, 60))
    scene = scene_with(CPU, fine, (fine, (0.01, 0.02, 0, 0, 0, 0.01, 1)))
    with testing.regime(plain_tests=10**9):
        expected = ab.Query(scene, "faces", pairs=[(0, 1)]).run()
    least = descent.slab_memory_words(0)
    with testing.regime(plain_tests=0):
        query = ab.Query(scene, "faces", pairs=[(0, 1)])
        found = [query.run().faces]
        assert query.traversal.slab_memory.shape[1] > least, "more subtrees than slots"
        monkeypatch.setattr(descent, "slab_memory_words", lambda depth: least)
        query = ab.Query(scene, "faces", pairs=[(0, 1)])
        assert query.traversal.slab_memory.shape[1] == least
        found.append(query.run().faces)
    for faces in found:
        np.testing.assert_array_equal(faces, expected.faces)


def test_slabs_that_stay_are_those_of_the_lod():
    """A query keeps slabs from launch to launch: poses, LODs and states that change places between do not mix."""
    cases = nested_cases(np.random.default_rng(6), 0.02)
    scene, pairs = scene_of(CPU, cases), pairs_of(cases)
    tops = scene.lods
    with testing.regime(plain_tests=0):
        kept = ab.Query(scene, "faces", pairs=pairs)
    for fractions in ([1, 1, 1, 1], [1, 1, 1, 1], [0.5, 1, 0.5, 1], [1, 1, 0.5, 1], [0.7, 0.6, 1, 0.9], [1, 1, 1, 1]):
        scene.set_lods((tops * fractions).astype(int))
        scene.set_poses(np.concatenate([[case[2], case[5]] for case in cases]) + [0.001 * sum(fractions), *6 * [0]])
        with testing.regime(plain_tests=10**9):
            expected = ab.Query(scene, "faces", pairs=pairs).run().faces
        np.testing.assert_array_equal(kept.run().faces, expected)
        assert len(expected) > 0


def test_slabs_serve_several_pairs_in_a_row():
    """Where hits are too frequent for a pair alone: from the second pair of an object on, in every launch alike."""
    model = sample("torus")
    scene = scene_with(CPU, model, *[(model, pose) for pose in random_poses(np.random.default_rng(7), 8, 0.5)])
    pairs = [(0, k) for k in range(1, 9)]
    found = {}
    for plain_tests, threads in ((10**9, 1), (10**4, 1), (10**4, 2)):
        with testing.regime(plain_tests=plain_tests, cpu_threads=threads):
            query = ab.Query(scene, "faces", pairs=pairs)
            found[plain_tests, threads] = query.run(), query.run()
    (plain, _), (one, again), (two, _) = found.values()
    assert (plain.count > 10).all() and (24 * plain.count < plain.node_tests).sum() > 4
    for result in (one, again, two):
        np.testing.assert_array_equal(result.faces, plain.faces)
        np.testing.assert_array_equal(result.node_tests, one.node_tests)
    assert one.node_tests[0] == plain.node_tests[0] and (one.node_tests < plain.node_tests).sum() > 4


def test_slabs_that_stay_fit_an_object_of_any_size():
    """A far larger object leaves directions no meaning, those of the smaller one's slabs too."""
    wide = 2.0**24 * np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0], [-1, -1, 1], [1, -1, 1], [0, 1, 1]])
    walls, model = model_of_faces(wide), sample("torus")
    placed = [(walls, (0, 0, z, 0, 0, 0, 1)) for z in np.linspace(-0.3, 0.3, 7)]
    scene = scene_with(CPU, model, (model, (0.01, 0.02, 0, 0, 0, 0, 1)), *placed)
    pairs = [(0, k) for k in range(1, 9)]
    found = []
    for plain_tests in (0, 10**9):
        with testing.regime(plain_tests=plain_tests, cpu_threads=1):
            found.append(ab.Query(scene, "faces", pairs=pairs).run())
    assert (found[1].count[1:] > 0).sum() > 3
    np.testing.assert_array_equal(found[0].faces, found[1].faces)


@wp.kernel
def list_leaf_pairs_kernel(
    margin_factor: wp.float32,
    trees: Trees,
    pair_poses: wp.array(dtype=PairPose),
    memory: wp.array2d(dtype=wp.float32),
    stack_inout: wp.array(dtype=wp.int64),
    faces_inout: wp.array(dtype=wp.int64),
    met_out: wp.array(dtype=wp.int32),
):
    """Note which faces of one number are a leaf pair that slabs do not separate, from the roots on."""
    pose = pair_poses[0]
    pose.margin = pose.margin * margin_factor
    state = descent.Descent()
    state.ready = AT_ONCE
    state.deep = 1
    descent.open_subtrees(trees, pose, state, memory)
    stack_inout[0] = first_item(trees.states, pose)
    while state.deep > 0:
        for i in range(descent.descend_subtrees(trees, pose, state, stack_inout, memory, faces_inout)):
            if item_first(faces_inout[i]) == item_second(faces_inout[i]):
                met_out[item_first(faces_inout[i])] = 1


def count_lost(query, count, margin_factor):
    """Return how many of the pairs that share a corner slabs separate."""
    memory = wp.zeros((1, descent.slab_memory_words(0)), dtype=wp.float32, device=CPU)
    lengths = descent.CPU_STACK_LENGTH, descent.WAITING_LENGTH
    buffers = [wp.empty(length, dtype=wp.int64, device=CPU) for length in lengths]
    met = wp.zeros(count, dtype=wp.int32, device=CPU)
    inputs = [margin_factor, query.batch.trees, query.pair_poses, memory, *buffers, met]
    wp.launch(list_leaf_pairs_kernel, dim=1, inputs=inputs, device=CPU)
    return int((met.numpy() == 0).sum())


def test_margin_covers_rounding():
    """Pairs that touch in a point survive beside coordinates that float32 rounds; without the margin some do not."""
    rng, count, lost = np.random.default_rng(8), 120, 0
    for reach in 10 ** rng.uniform(3, 6, 20):
        models, pose = touching_soups(rng, count, 1e-3, reach)
        query = ab.Query(scene_with(CPU, models[0], (models[1], pose)), "faces", pairs=[(0, 1)])
        assert query.run().count[0] >= count
        assert count_lost(query, count, 1.0) == 0
        lost += count_lost(query, count, 0.0)
    assert lost > 20
