"""Candidate pairs against brute force over posed root boxes; worlds, static objects, filters."""

from fractions import Fraction

import hypothesis.strategies as st
import numpy as np
import pytest
from helpers.questions import sort_rows
from helpers.samples import STILL, random_poses, raw_state, sample
from hypothesis import HealthCheck, given, settings
from oracles.triangle import pose_matrix

import warp_abtree as ab

NAMES = ("box", "crumbs", "grid", "three")
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)


def posed_boxes(scene, poses):
    """Return lower and upper (n, 3) of the posed root boxes in float64."""
    lower, upper = [], []
    for i, pose in enumerate(poses):
        state = raw_state(scene, i)
        centre = scene.models[scene.object_model[i]].centre
        ends = np.stack([state["lower"][1], state["upper"][1]]).astype(np.float64) + centre
        rotation, position = pose_matrix(pose)
        points = np.take_along_axis(ends, CORNERS, 0) @ rotation.T + position
        lower.append(points.min(0))
        upper.append(points.max(0))
    return np.array(lower), np.array(upper)


def overlaps(lower, upper, slack):
    """Return which boxes overlap when each is widened by slack times its largest coordinate, bool (n, n)."""
    room = slack * np.maximum(np.abs(lower), np.abs(upper)).max(1)[:, None]
    lower, upper = lower - room, upper + room
    return ((lower[:, None] <= upper) & (upper[:, None] >= lower)).all(2)


def check_pairs(scene, poses, worlds, statics, excluded=()):
    """Compare with brute force: all pairs that overlap, and none that float32 can tell apart. Returns the pairs."""
    pairs = scene.broad_phase()
    assert pairs.dtype == np.int32 and pairs.ndim == 2 and pairs.shape[1] == 2
    np.testing.assert_array_equal(pairs, np.unique(pairs, axis=0), "sorted, each once")
    worlds, statics = np.array(worlds), np.array(statics)
    may = (worlds[:, None] == worlds) | (worlds[:, None] == -1) | (worlds == -1)
    may &= ~(statics[:, None] & statics)
    for i, j in excluded:
        may[i, j] = may[j, i] = False
    may, found = np.triu(may, 1), np.zeros_like(may)
    found[pairs[:, 0], pairs[:, 1]] = True
    lower, upper = posed_boxes(scene, poses)
    assert not (may & overlaps(lower, upper, -1e-13) & ~found).any()
    assert not (found & ~(may & overlaps(lower, upper, 3e-7))).any()
    return pairs


def make_scene(device, models, poses, worlds, statics, lods=None):
    scene = ab.Scene(device)
    for i, model in enumerate(models):
        lod = None if lods is None else round(lods[i] * model.lod_max)
        scene.add(model, poses[i], world=worlds[i], static=statics[i], lod=lod)
    return scene


objects = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.tuples(*[st.integers(-6, 6)] * 3),
        st.sampled_from([(0, 0, 0, 1), (0, 0, 1, 0), (0.5, 0.5, 0.5, 0.5), (0.6, 0, 0.8, 0), (0.1, 0.7, -0.7, 0.1)]),
        st.sampled_from([-1, 0, 0, 0, 1, 7, 2**31 - 1]),
        st.booleans(),
        st.sampled_from([0.0, 0.3, 1.0]),
    ),
    min_size=2,
    max_size=25,
)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(objects, st.lists(st.tuples(st.integers(0, 24), st.integers(0, 24)), max_size=8))
def test_random_scenes_equal_brute_force(device, things, excluded):
    """Positions on a lattice, so that boxes often touch."""
    names, positions, quaternions, worlds, statics, lods = zip(*things, strict=True)
    quaternions = np.array(quaternions) / np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses = np.concatenate([0.5 * np.array(positions), quaternions], 1)
    scene = make_scene(device, [sample(name) for name in names], poses, worlds, statics, lods)
    check_pairs(scene, poses, worlds, statics)
    excluded = [(i, j) for i, j in excluded if i != j and max(i, j) < len(things)]
    for i, j in excluded:
        scene.filter([(i, j)])
    check_pairs(scene, poses, worlds, statics, excluded)


def test_many_objects_after_moves_and_lods(device):
    rng = np.random.default_rng(1)
    models = [sample(name) for name in rng.choice(NAMES, 600)]
    worlds, statics = rng.integers(-1, 3, 600), rng.random(600) < 0.3
    poses = random_poses(rng, 600, 6.0)
    scene = make_scene(device, models, poses, worlds.tolist(), statics.tolist())
    assert len(check_pairs(scene, poses, worlds, statics)) > 300
    poses = random_poses(rng, 600, 4.0)
    scene.set_poses(poses)
    scene.set_lods([rng.integers(0, model.lod_max + 1) for model in models])
    assert len(check_pairs(scene, poses, worlds, statics)) > 600


def test_far_from_the_origin_nothing_is_missed(device):
    """Boxes in the world are float32: far away they are coarser, never too small."""
    rng = np.random.default_rng(2)
    poses = random_poses(rng, 120, 4.0)
    poses[:, :3] += [-3e7, 0, 3e7]
    scene = make_scene(device, [sample("crumbs")] * 120, poses, [0] * 120, [False] * 120)
    assert len(check_pairs(scene, poses, [0] * 120, [False] * 120)) > 100


def exact_box(scene, i, pose):
    """Return lower and upper end of an object's posed root box, three fractions each, for a pose taken as a matrix."""
    state = raw_state(scene, i)
    ends = [[Fraction(float(x)) for x in state[name][1]] for name in ("lower", "upper")]
    centre = [Fraction(x) for x in scene.models[scene.object_model[i]].centre.tolist()]
    lower, upper = [], []
    for row, position in zip(pose[:3, :3].tolist(), pose[:3, 3].tolist(), strict=True):
        parts = [(Fraction(r) * (c + p), Fraction(r) * (c + q)) for r, c, p, q in zip(row, centre, *ends, strict=True)]
        lower.append(Fraction(position) + sum(map(min, parts)))
        upper.append(Fraction(position) + sum(map(max, parts)))
    return lower, upper


@pytest.mark.parametrize("far", [0.0, 2.0**36])
def test_boxes_in_the_world_contain_what_they_box(device, far):
    """In fractions, models as far from their own origin as poses bring them back; and boxes are not much too large."""
    rng = np.random.default_rng(4)
    poses = np.tile(np.eye(4), (40, 1, 1))
    scene = ab.Scene(device)
    for pose in poses:
        place = far * rng.normal(size=3)
        pose[:3, :3] = pose_matrix(random_poses(rng, 1, 1.0)[0])[0]
        pose[:3, 3] = rng.normal(size=3) - pose[:3, :3] @ place
        scene.add(ab.Model.from_arrays(place + rng.normal(size=(3, 3)), [[0, 1, 2]]), pose)
    query = ab.Query(scene, "any")
    query.run()
    boxes = [corner.numpy().tolist() for corner in (query.broad_phase.lower, query.broad_phase.upper)]
    room = Fraction(4e-7) + Fraction(40 * 2.0**-48 * far)
    for i, pose in enumerate(poses):
        for lower, upper, least, most in zip(boxes[0][i], boxes[1][i], *exact_box(scene, i, pose), strict=True):
            assert least - 4 * room < Fraction(lower) < least
            assert most < Fraction(upper) < most + 4 * room


def test_thousand_worlds(device):
    """Everything overlaps everything, and only worlds keep it apart."""
    scene, worlds = ab.Scene(device), np.concatenate([1001 * np.repeat(np.arange(1000), 3), [-1, -1]])
    worlds = np.random.default_rng(3).permutation(worlds)
    for world in worlds:
        scene.add(sample("box"), world=int(world))
    shared = (worlds[:, None] == -1) | (worlds == -1)
    expected = np.argwhere(np.triu((worlds[:, None] == worlds) | shared, 1))
    np.testing.assert_array_equal(scene.broad_phase(), expected)
    np.testing.assert_array_equal(sort_rows(scene.intersect().pairs), expected)
    apart = [(i, i + 1) for i in range(9) if worlds[i] != worlds[i + 1]]
    assert scene.intersect(apart).any.all(), "a pair that is asked for is tested whatever its worlds"


def test_filter_adds_up_and_outlives_changes(device):
    box = sample("box")
    scene = make_scene(device, [box] * 4, [STILL] * 4, [0] * 4, [False] * 4)
    scene.filter([(0, 1), (3, 2)])
    scene.filter(np.array([[1, 0], [0, 3]]))
    scene.filter([])
    np.testing.assert_array_equal(scene.broad_phase(), [(0, 2), (1, 2), (1, 3)])
    scene.add(box)
    scene.set_lods([0] * 5)
    np.testing.assert_array_equal(scene.broad_phase(), [(0, 2), (0, 4), (1, 2), (1, 3), (1, 4), (2, 4), (3, 4)])
    assert scene.intersect([(0, 1)]).any.all(), "a pair that is asked for is tested all the same"
    assert len(scene.intersect().pairs) == 7


def test_distances_beyond_float32(device):
    """Objects out of float32's reach neither vanish nor hide the others."""
    box = sample("box")
    poses = np.tile(STILL, (40, 1))
    poses[:, 0] = 0.75 * np.arange(40)
    poses[::4, 0] = 1e300
    poses[1::8, 1] = -1e200
    scene = make_scene(device, [box] * 40, poses, [0] * 40, [False] * 40)
    found = set(map(tuple, scene.broad_phase().tolist()))
    lower, upper = posed_boxes(scene, poses)
    needed = set(map(tuple, np.argwhere(np.triu(overlaps(lower, upper, 0.0), 1)).tolist()))
    assert needed <= found
    meets = scene.intersect()
    assert {tuple(pair) for pair, hit in zip(meets.pairs.tolist(), meets.any, strict=True) if hit} == needed


@pytest.mark.parametrize("order", [1, -1])
def test_frames_off_orthonormal_hide_no_pair(device, order):
    """Matrices rigid within 1e-6 are taken as they are: faces that meet by the exact test are candidates."""
    model = sample("box")
    shrunk = np.diag([1 - 4.9e-7] * 3 + [1.0])
    meets = []
    for gap in (-9.5e-7, 0.0, 4.0e-7, 4.9e-7, 9e-7):
        scene, other = ab.Scene(device), np.eye(4)
        # The boxes' faces lie half a unit from their middles; only the first frame is off.
        other[0, 3] = order * (1 + gap / 2)
        scene.add(model, shrunk)
        scene.add(model, other)
        meets.append(scene.intersect([(0, 1)]).any[0])
        assert len(scene.broad_phase()) or not meets[-1]
        assert scene.intersect().any.any() == meets[-1]
    assert meets[0] and meets[2] and not meets[-1], meets
