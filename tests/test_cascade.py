"""The cascade against the finest exact answer: touching and nearly touching poses, every output, both regimes."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from oracle_triangle import pose_matrix
from samples import random_poses, random_quaternions, sample

import warp_abtree as ab

RUNGS = (0.01, 0.05, 0.2, 0.5)
PAIRS = [
    ("torus", "torus"),
    ("torus", "grid"),
    ("small ball", "crumbs"),
    ("soup", "capsule"),
    ("grid", "grid"),
    ("crumbs", "torus"),
    ("lattice soup", "small ball"),
    ("ball", "box"),
]


class WarpCascade(ab.Cascade):
    """A cascade that takes the CUDA regime on every device."""

    def uses_warps(self):
        return True


WORLD = np.eye(4)
WORLD[:3, :3], WORLD[:3, 3] = pose_matrix((0, 0, 0, 0.1, -0.7, 0.5, 0.5))[0], (3, -20, 0.7)


def place(scene, matrices):
    """Pose object 0 somewhere and the others by matrices (p, 4, 4) in its frame."""
    scene.set_poses(WORLD @ np.concatenate([np.eye(4)[None], matrices]))


def touching_poses(rng, scene, names, count):
    """Return where B is last in contact on its way out of A, where it is not, and its direction, for any rotations.

    Found by bisection of the exact answer down to neighbouring floats, or nearly.
    """
    corners = [sample(name).mesh_at(sample(name).lod_max)[0] for name in names]
    centres = [(points.min(0) + points.max(0)) / 2 for points in corners]
    reach = sum(np.linalg.norm(p - c, axis=1).max() for p, c in zip(corners, centres, strict=True))
    turned = np.tile(np.eye(4), (count, 1, 1))
    turned[:, :3, :3] = [pose_matrix((0, 0, 0, *q))[0] for q in random_quaternions(rng, count)]
    turned[:, :3, :3] *= rng.choice([1 - 4e-7, 1, 1 + 4e-7], (count, 1, 1))  # rotations that are a little off
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    query = ab.Query(scene, "any", pairs=[(0, k + 1) for k in range(count)])

    def at(along):
        matrices = turned.copy()
        matrices[:, :3, 3] = centres[0] + along[:, None] * away - matrices[:, :3, :3] @ centres[1]
        return matrices

    def meets(along):
        place(scene, at(along))
        return query.run().any

    steps = np.linspace(0, 1.01 * reach, 40)
    low = np.full(count, -1.0)
    for step in steps:
        low = np.where(meets(np.full(count, step)), step, low)
    chosen = low >= 0
    assert chosen.sum() > count / 3
    high = low + steps[1]
    for _ in range(50):
        middle = (low + high) / 2
        met = meets(middle)
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    return at, low, high, chosen


@pytest.mark.parametrize("names", PAIRS, ids="-".join)
def test_never_apart_where_the_originals_meet(device, names):
    """Over 1,000 poses a case: touching, gaps from 1e-15 to the bound and beyond. Half the bound would be wrong."""
    rng = np.random.default_rng(sum(map(ord, "".join(names))))
    count = 150
    models = [sample(name) for name in names]
    scene = ab.Scene(device)
    scene.add(models[0])
    for _ in range(count):
        scene.add(models[1])
    at, low, high, chosen = touching_poses(rng, scene, names, count)
    pairs = np.array([(0, k + 1) for k in range(count)])[chosen]
    finest = ab.Query(scene, "count", pairs=pairs)
    cascades = [ab.Cascade(scene, "count", pairs, (share,)) for share in RUNGS]
    bounds = [sum(m.error_at(int(lod)) for m, lod in zip(models, cascades[k].lods[0][[0, -1]])) for k in range(4)]
    cascades.append(ab.Cascade(scene, "count", pairs, RUNGS))
    gaps = [low, high, high + 1e-15, high + 1e-9]
    gaps += [high + factor * bound * rng.random(count) for bound in bounds for factor in (0.1, 3.0)]
    met = settled = 0
    for along in gaps:
        place(scene, at(along))
        truth = finest.run()
        met += truth.any.sum()
        for query in cascades:
            found = query.run()
            settled += found.apart.sum()
            assert not (found.apart & truth.any).any()
            np.testing.assert_array_equal(found.any, truth.any)
            np.testing.assert_array_equal(found.count, truth.count)
    assert met > 50 and settled > 50


def test_poses_that_touch_tell_a_wrong_bound(device):
    """Of all poses that touch, some are proved apart by a bound a little smaller: so those above are sharp."""
    rng = np.random.default_rng(9)
    count, wrong = 300, {0.5: 0, 0.8: 0}
    for names in PAIRS:
        models = [sample(name) for name in names]
        scene = ab.Scene(device)
        scene.add(models[0])
        for _ in range(count):
            scene.add(models[1])
        at, low, _, chosen = touching_poses(rng, scene, names, count)
        place(scene, at(low))
        pairs = np.array([(0, k + 1) for k in range(count)])[chosen]
        for share in RUNGS:
            lods = [model.lod_for(fraction=share) for model in models]
            scene.set_lods([lods[0]] + [lods[1]] * count)
            bound = sum(model.error_at(lod) for model, lod in zip(models, lods, strict=True))
            for factor in wrong:
                wrong[factor] += scene.intersect(pairs, within=factor * bound).apart.sum()
            assert not scene.intersect(pairs, within=bound).apart.any()
    assert all(wrong.values()), wrong


def field(device, lod=None, count=60, seed=1, spread=2.2):
    """Return a scene of mixed models at one LOD share or the finest, and all pairs in random order and direction."""
    rng = np.random.default_rng(seed)
    names = ("torus", "soup", "grid", "small ball", "crumbs")
    scene = ab.Scene(device)
    for k, pose in enumerate(random_poses(rng, count, spread)):
        model = sample(names[k % len(names)])
        scene.add(model, pose, lod=None if lod is None else model.lod_for(fraction=lod))
    pairs = rng.permutation(np.stack(np.triu_indices(count, 1), 1))
    flip = rng.random(len(pairs)) < 0.5
    pairs[flip] = pairs[flip][:, ::-1]
    return scene, pairs


def assert_same(found, truth):
    for name in ("pairs", "any", "count", "faces"):
        one, other = getattr(found, name), getattr(truth, name)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("output", ["any", "count", "faces"])
@pytest.mark.parametrize("rungs", [(), (0.2,), RUNGS])
@pytest.mark.parametrize("kind", [ab.Cascade, WarpCascade])
def test_equals_the_finest_answer(device, output, rungs, kind):
    """Whatever LOD the objects stand at, which stays; work on the originals is that of the pairs left."""
    scene, pairs = field(device, lod=0.1)
    fine, _ = field(device)
    lods = scene.lods
    before = scene.intersect(pairs, output)
    truth = fine.intersect(pairs, output)
    query = kind(scene, output, pairs, rungs)
    found = query.run()
    assert_same(found, truth)
    assert found.any.sum() > 100 and not np.array_equal(before.any, truth.any)
    assert_same(scene.intersect(pairs, output), before)
    np.testing.assert_array_equal(scene.lods, lods)
    left = found.rung == len(rungs)
    np.testing.assert_array_equal(found.apart, ~left)
    assert rungs == () or 100 < left.sum() < len(pairs) - 100
    assert not found.node_tests[~left].any() and not found.triangle_tests[~left].any()
    assert (found.proof_node_tests > 0).all() == bool(rungs)
    if output != "any" and kind is ab.Cascade:
        np.testing.assert_array_equal(found.node_tests[left], truth.node_tests[left])
        np.testing.assert_array_equal(found.exact_tests[left], truth.exact_tests[left])


def test_rungs_settle_what_they_prove(device):
    """The rung of a pair is the first at which a scene at these LODs proves it apart."""
    scene, pairs = field(device)
    found = ab.intersect_originals(scene, pairs, rungs=RUNGS)
    expected = np.full(len(pairs), len(RUNGS))
    for rung in reversed(range(len(RUNGS))):
        coarse, _ = field(device, lod=RUNGS[rung])
        errors = np.array([coarse.models[m].error_at(lod) for m, lod in zip(coarse.object_model, coarse.lods)])
        within = np.nextafter(errors[pairs].sum(1), np.inf)
        expected[coarse.intersect(pairs, within=within).apart] = rung
    np.testing.assert_array_equal(found.rung, expected)
    assert len(np.unique(expected)) == len(RUNGS) + 1


def test_poses_follow_the_scene(device):
    scene, pairs = field(device, lod=0.1)
    fine, _ = field(device)
    query = ab.Cascade(scene, "faces", pairs)
    assert len(query.arrays[1].slots) == 2 * len(scene.models), "objects of a model share its states"
    rng = np.random.default_rng(2)
    for spread in (1.5, 3.0):
        poses = random_poses(rng, scene.object_count, spread)
        scene.set_poses(poses)
        fine.set_poses(poses)
        scene.set_lods([model.lod_for(fraction=rng.random()) for model in np.array(scene.models)[scene.object_model]])
        assert_same(query.run(), fine.intersect(pairs, "faces"))


def test_takes_other_pairs(device):
    scene, pairs = field(device)
    query = ab.Cascade(scene, "faces", pairs[:10], RUNGS)
    for asked in (pairs[:10], pairs, pairs[50:90], pairs[:0], pairs[3:4]):
        query.set_pairs(asked)
        assert_same(query.run(), scene.intersect(asked, "faces"))
    far = ab.intersect_originals(scene, pairs, rungs=RUNGS)
    query.set_pairs(pairs[far.apart])  # nothing is left for the originals, after something was
    assert query.run().apart.all() and len(query.run().faces) == 0


@pytest.mark.parametrize("kind", [ab.Cascade, WarpCascade])
def test_buffers_grow_and_lose_nothing(device, kind):
    scene, pairs = field(device)
    truth = scene.intersect(pairs, "faces")
    query = kind(scene, "faces", pairs, capacity=1, unsure_capacity=1)
    query.launch()
    with pytest.raises(ab.CapacityError):
        query.result().check()
    assert_same(query.run(), truth)
    query.launch()
    query.result().check()
    assert_same(query.result(), truth)


def test_broad_phase(device):
    """Boxes of the originals, sorted for `intersect_originals`; worlds and filters as in the scene."""
    scene, fine = ab.Scene(device), ab.Scene(device)
    for k, pose in enumerate(random_poses(np.random.default_rng(3), 40, 1.5)):
        for where in (scene, fine):
            lod = 0 if where is scene else None
            where.add(sample("torus"), pose, world=k % 2, lod=lod, static=k % 3 == 0)
    for where in (scene, fine):
        where.filter([(0, 2), (5, 1)])
    truth = fine.intersect(output="faces")
    assert_same(ab.intersect_originals(scene, output="faces"), truth)
    query = ab.Cascade(scene, "faces", pair_capacity=1, rungs=RUNGS)
    found = query.run()
    order = np.lexsort(found.pairs.T[::-1])
    np.testing.assert_array_equal(found.pairs[order], truth.pairs)
    np.testing.assert_array_equal(found.count[order], truth.count)
    place_of = np.argsort(order)
    faces = np.concatenate([place_of[found.faces[:, :1]], found.faces[:, 1:]], 1)
    np.testing.assert_array_equal(faces[np.lexsort(faces.T[::-1])], truth.faces)


def test_bound_is_the_true_sum_rounded_up(device):
    scene, pairs = field(device)
    query = ab.Cascade(scene, "any", pairs)
    rng = np.random.default_rng(4)
    errors = rng.random(scene.object_count) * 2.0 ** rng.integers(-60, 60, scene.object_count)
    query._errors[0].assign(errors)
    query.launch()
    within = query._lists[0].within.numpy()
    for (i, j), d in zip(pairs.tolist(), within.tolist(), strict=True):
        true = Fraction(errors[i]) + Fraction(errors[j])
        assert true <= Fraction(d) <= true * (1 + Fraction(1, 2**49))


def test_launch_is_captured(device):
    """Replays ask the poses of their time, which settle other pairs than those of the capture."""
    scene, pairs = field(device, count=30)
    queries = [ab.Cascade(scene, "faces", pairs, RUNGS)]
    if scene.device.is_cuda:
        queries.append(ab.Cascade(scene, "faces", rungs=RUNGS, pair_capacity=len(pairs)))
    for query in queries:
        query.resize(500_000)
        first = query.run()
        with wp.ScopedCapture(scene.device) as capture:
            query.launch()
        for spread in (1.8, 4.0, 40.0):
            scene.set_poses(random_poses(np.random.default_rng(5), scene.object_count, spread))
            wp.capture_launch(capture.graph)
            replayed = query.result()
            replayed.check()
            assert_same(replayed, scene.intersect(replayed.pairs, "faces"))
            assert not np.array_equal(replayed.rung, first.rung)
        scene.set_poses(random_poses(np.random.default_rng(1), scene.object_count, 2.2))


def test_objects_added_ask_for_another(device):
    scene, pairs = field(device)
    query = ab.Cascade(scene, "any", pairs)
    scene.add(sample("box"))
    with pytest.raises(RuntimeError, match="make a new one"):
        query.launch()


@pytest.mark.parametrize(
    "rungs", [0.2, (0,), (1,), (1.5,), (-0.1,), (np.nan,), (0.2, 0.2), (0.2, 0.1), ("a",), (True,), None, (None,)]
)
def test_bad_rungs(device, rungs):
    scene, pairs = field(device, count=4)
    with pytest.raises(ValueError, match="rungs"):
        ab.Cascade(scene, "any", pairs, rungs)


def test_bad_requests(device):
    scene, pairs = field(device, count=4)
    with pytest.raises(ValueError, match="ContactQuery"):
        ab.intersect_originals(scene, pairs, "contacts")
    with pytest.raises(ValueError, match="precision"):
        ab.intersect_originals(scene, pairs, precision="half")
    with pytest.raises(ValueError, match="pairs"):
        ab.Cascade(scene, pairs=[(0, 9)])
    with pytest.raises(ValueError, match="no object"):
        ab.Cascade(ab.Scene(device))
    alone = ab.Scene(device)
    alone.add(sample("box"))
    assert len(ab.intersect_originals(alone).pairs) == 0
