"""Candidate pairs against brute force over posed root boxes; worlds, static objects, filters."""

from fractions import Fraction

import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import sort_rows, to_matrix
from helpers.samples import STILL, random_poses, raw_state, sample
from helpers.scenes import scene_with
from hypothesis import HealthCheck, given, settings
from oracles.triangle import fractions, pose_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.intersect.broad_phase import PosedBounds, write_bounds
from warp_abtree.query.broad_phase import BroadPhase

NAMES = ("box", "crumbs", "grid", "three")
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)


REGIMES = {"as by default": {}, "tiles": {"warps": True}, "tiles along a curve": {"warps": True, "tile_tasks": 0}}


@pytest.fixture(params=REGIMES, autouse=True)
def search(request):
    """Find pairs as the device does, and in tiles of one object on the CPU, sorted or not."""
    with testing.regime(**REGIMES[request.param]):
        yield request.param


def posed_boxes(scene, poses):
    """Return lower and upper (n, 3) of the posed root boxes in float64."""
    points = []
    for i, pose in enumerate(poses):
        state = raw_state(scene, i)
        centre = scene.models[scene.object_model[i]].centre
        ends = np.stack([state["lower"][1], state["upper"][1]]).astype(np.float64) + centre
        rotation, position = pose_matrix(pose)
        points.append(np.take_along_axis(ends, CORNERS, 0) @ rotation.T + position)
    return np.min(points, 1), np.max(points, 1)


def overlaps(lower, upper, slack):
    room = slack and slack * np.maximum(np.abs(lower), np.abs(upper)).max(1)[:, None]
    lower, upper = lower - room, upper + room
    return ((lower[:, None] <= upper) & (upper[:, None] >= lower)).all(2)


def check_pairs(scene, poses, worlds, statics, excluded=(), bits=None):
    """Compare with brute force: all pairs that overlap, and none that float32 can tell apart. Returns the pairs."""
    pairs = scene.broad_phase()
    assert pairs.dtype == np.int32 and pairs.ndim == 2 and pairs.shape[1] == 2
    np.testing.assert_array_equal(pairs, np.unique(pairs, axis=0), "sorted, each once")
    worlds, statics = np.array(worlds), np.array(statics)
    may = (worlds[:, None] == worlds) | (worlds[:, None] == -1) | (worlds == -1)
    may &= ~(statics[:, None] & statics)
    for i, (group, mask) in enumerate([] if bits is None else bits):
        for j, (other_group, other_mask) in enumerate(bits):
            may[i, j] &= (group & other_mask) != 0 and (other_group & mask) != 0
    for i, j in excluded:
        may[i, j] = may[j, i] = False
    may, found = np.triu(may, 1), np.zeros_like(may)
    found[pairs[:, 0], pairs[:, 1]] = True
    lower, upper = posed_boxes(scene, poses)
    assert not (may & overlaps(lower, upper, -1e-13) & ~found).any()
    assert not (found & ~(may & overlaps(lower, upper, 3e-7))).any()
    return pairs


def make_scene(device, names, poses, worlds=None, statics=None, lods=None, bits=None):
    """Return a scene of samples, all in world 0, none of them static, at their finest unless told."""
    scene = ab.Scene(device)
    for i, model in enumerate(map(sample, names)):
        world, static = (0 if worlds is None else int(worlds[i])), statics is not None and bool(statics[i])
        group, mask = (1, 2**32 - 1) if bits is None else bits[i]
        lod = lods and round(lods[i] * model.lod_max)
        scene.add(model, poses[i], world, lod, static=static, collision_group=group, collision_mask=mask)
    return scene


objects = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.tuples(*[st.integers(-6, 6)] * 3),
        st.sampled_from([(0, 0, 0, 1), (0, 0, 1, 0), (0.5, 0.5, 0.5, 0.5), (0.6, 0, 0.8, 0), (0.1, 0.7, -0.7, 0.1)]),
        st.sampled_from([-1, 0, 0, 0, 1, 7, 2**31 - 1]),
        st.booleans(),
        st.sampled_from([0.0, 0.3, 1.0]),
        st.sampled_from([(1, 2**32 - 1)] * 3 + [(2, 1), (0, 3), (3, 0), (2**31, 2**32 - 1), (5, 2**31 + 4)]),
    ),
    min_size=2,
    max_size=25,
)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(objects, st.lists(st.tuples(st.integers(0, 24), st.integers(0, 24)), max_size=8))
def test_random_scenes_equal_brute_force(device, things, excluded):
    """Positions on a lattice, so that boxes often touch."""
    names, positions, quaternions, worlds, statics, lods, bits = zip(*things, strict=True)
    quaternions = np.array(quaternions) / np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses = np.concatenate([0.5 * np.array(positions), quaternions], 1)
    scene = make_scene(device, names, poses, worlds, statics, lods, bits)
    check_pairs(scene, poses, worlds, statics, bits=bits)
    excluded = [(i, j) for i, j in excluded if i != j and max(i, j) < len(things)]
    for i, j in excluded:
        scene.filter([(i, j)])
    pairs = check_pairs(scene, poses, worlds, statics, excluded, bits)
    pipeline = ab.Pipeline(scene, output="any", capacity=ab.Buffers(pairs=400))
    pipeline.launch()
    np.testing.assert_array_equal(sort_rows(pipeline.result().pairs), pairs, "the pipeline's own objects")


@pytest.mark.parametrize("worlds", ["one", "some", "shared first", "shared"])
def test_sorted_pairs_and_their_keys(device, worlds):
    """As many as there is room for, and how many there are, in the order of the objects."""
    rng = np.random.default_rng(5)
    names, poses, world = rng.choice(NAMES, 300), random_poses(rng, 300, 2.5), np.zeros(300, int)
    if worlds in ("some", "shared"):
        world = rng.integers(0 if worlds == "some" else -1, 3, 300)
    elif worlds == "shared first":
        world[:2] = -1
    scene = make_scene(device, names, poses, world, rng.random(300) < 0.2)
    scene.filter([(0, 1), (7, 3), (250, 90)])
    expected = scene.broad_phase()
    assert len(expected) > 300
    for room in (len(expected) + 100, len(expected), len(expected) // 2):
        broad_phase = BroadPhase(scene.batch(), room, sorts=True)
        for _ in range(2):
            broad_phase.launch()
        assert broad_phase.count_found() == len(expected)
        if room >= len(expected):
            np.testing.assert_array_equal(broad_phase.pairs.numpy()[: len(expected)], expected)
            keys, wide = broad_phase.key.numpy()[:room], expected.astype(np.int64)
            np.testing.assert_array_equal(keys[: len(expected)], (wide[:, 0] << 32) + wide[:, 1])
            assert (keys[len(expected) :] == 2**63 - 1).all()


def exact_box(scene, i, pose):
    """Return lower and upper end of an object's posed root box, three fractions each, for a pose taken as a matrix."""
    state, centre = raw_state(scene, i), scene.models[scene.object_model[i]].centre
    ends = fractions([state["lower"][1], state["upper"][1]]) + fractions(centre)
    parts = fractions(pose[:3, :3]) * ends[:, None]
    return [fractions(pose[:3, 3]) + part.sum(1) for part in (parts.min(0), parts.max(0))]


@pytest.mark.parametrize("far", [0.0, 2.0**36])
def test_boxes_in_the_world_contain_what_they_box(device, far):
    """In fractions, models as far from their own origin as poses bring them back; and boxes are not much too large."""
    rng, scene, poses = np.random.default_rng(4), ab.Scene(device), []
    for _ in range(40):
        place, rotation = far * rng.normal(size=3), pose_matrix(random_poses(rng, 1, 1.0)[0])[0]
        poses.append(to_matrix(rotation, rng.normal(size=3) - rotation @ place))
        scene.add(ab.Model.from_arrays(place + rng.normal(size=(3, 3)), [[0, 1, 2]]), poses[-1])
    query = ab.Query(scene, "any")
    query.run()
    boxes = [corner.numpy().tolist() for corner in (query.broad_phase.lower, query.broad_phase.upper)]
    room = Fraction(4e-7) + Fraction(40 * 2.0**-48 * far)
    for i, pose in enumerate(poses):
        for lower, upper, least, most in zip(boxes[0][i], boxes[1][i], *exact_box(scene, i, pose), strict=True):
            assert least - 4 * room < Fraction(lower) < least
            assert most < Fraction(upper) < most + 4 * room


@pytest.mark.parametrize("seed", range(2))
def test_boxes_of_all_sizes(device, seed):
    """From a thousandth to one that holds all, in worlds of 1 to 500 objects with gaps between their numbers."""
    rng = np.random.default_rng(seed)
    sizes = 10.0 ** rng.uniform(-2, 0.3, 700)
    sizes[rng.integers(0, 700, 3)] = 60.0
    worlds = rng.choice([-1, 0, 5, 6, 7, 2**31 - 1], 700, p=[0.01, 0.7, 0.1, 0.1, 0.08, 0.01])
    statics = rng.random(700) < 0.2
    scene, models = ab.Scene(device), {}
    poses = random_poses(rng, 700, 5.0)
    for size, pose, world, static in zip(sizes, poses, worlds, statics):
        key = round(float(np.log10(size)), 1)
        if key not in models:
            models[key] = ab.Model.load(trimesh.creation.box((10**key,) * 3))
        scene.add(models[key], pose, int(world), static=bool(static))
    assert len(check_pairs(scene, poses, worlds, statics)) > 700


@wp.kernel
def copy_bounds_kernel(lower: wp.array(dtype=wp.vec3), upper: wp.array(dtype=wp.vec3), boxes_out: PosedBounds):
    write_bounds(wp.tid(), lower[wp.tid()], upper[wp.tid()], boxes_out)


class GivenBoxes:
    def __init__(self, lower, upper, device):
        self.ends = [wp.array(end, dtype=wp.vec3, device=device) for end in (lower, upper)]

    def given(self):
        return ()

    def make(self, launch, guard, boxes):
        return launch(copy_bounds_kernel, dim=len(boxes.lower), inputs=[*self.ends, boxes], device=boxes.lower.device)


@pytest.mark.parametrize("count", [1, 2, 33, 100, 517])
def test_closed_boxes_in_whole_numbers(device, count):
    """Many touch in a face, an edge or a corner; some are points, some infinite, or no numbers."""
    rng, scene = np.random.default_rng(count), ab.Scene(device)
    worlds = rng.integers(-1, 3, count)
    scene.add_many(sample("box"), np.tile(STILL, (count, 1)), worlds)
    lower = rng.integers(-9, 9, (count, 3)).astype(np.float32)
    upper = lower + rng.integers(0, 4, (count, 3))
    open_lower, open_upper = rng.random((2, count, 3)) < 0.02
    lower[open_lower], upper[open_upper] = -np.inf, np.inf
    given = np.where(open_lower & (rng.random((count, 3)) < 0.5), np.nan, lower)
    broad_phase = BroadPhase(scene.batch(), boxes=GivenBoxes(given, upper, scene.device))
    may = np.triu((worlds[:, None] == worlds) | (worlds[:, None] == -1) | (worlds == -1), 1)
    np.testing.assert_array_equal(broad_phase.find(), np.argwhere(may & overlaps(lower, upper, 0.0)))


@pytest.mark.slow
def test_more_pairs_than_can_be_numbered(device, search):
    """66,000 objects in one place: one error, and no count that has gone round."""
    if search != "as by default" and not wp.get_device(device).is_cuda:
        pytest.skip("tiles of one object")
    scene = ab.Scene(device)
    scene.add_many(sample("box"), np.tile(STILL, (66_000, 1)))
    refused(ab.CapacityError, "2\\^31 object pairs or more", scene.broad_phase)


def test_thousand_worlds(device):
    worlds = np.concatenate([1001 * np.repeat(np.arange(1000), 3), [-1, -1]])
    scene, worlds = ab.Scene(device), np.random.default_rng(3).permutation(worlds)
    scene.add_many(sample("box"), np.tile(STILL, (len(worlds), 1)), worlds)
    expected = np.argwhere(np.triu((worlds[:, None] == worlds) | (worlds[:, None] == -1) | (worlds == -1), 1))
    np.testing.assert_array_equal(scene.broad_phase(), expected)
    np.testing.assert_array_equal(sort_rows(scene.intersect().pairs), expected)
    query = ab.Query(scene, "faces")
    assert query.rooms.pairs == len(expected), "no room for more pairs than worlds allow"
    assert query.rooms.hits == 16 * 4 * len(worlds), "but for as many hits as of objects in one world"
    apart = [(i, i + 1) for i in range(9) if worlds[i] != worlds[i + 1]]
    assert scene.intersect(apart).any.all(), "a pair that is asked for is tested whatever its worlds"


def test_filter_adds_up_and_outlives_changes(device):
    scene = make_scene(device, ["box"] * 4, [STILL] * 4)
    scene.filter([(0, 1), (3, 2)])
    scene.filter(np.array([[1, 0], [0, 3]]))
    scene.filter([])
    np.testing.assert_array_equal(scene.broad_phase(), [(0, 2), (1, 2), (1, 3)])
    scene.add(sample("box"))
    scene.set_lods([0] * 5)
    np.testing.assert_array_equal(scene.broad_phase(), [(0, 2), (0, 4), (1, 2), (1, 3), (1, 4), (2, 4), (3, 4)])
    assert scene.intersect([(0, 1)]).any.all(), "a pair that is asked for is tested all the same"
    assert len(scene.intersect().pairs) == 7


def test_a_filter_that_repeats_per_world_is_one_call(device):
    """Three links in each of five worlds and a post in all: neighbouring links are left out, as pair by pair."""
    scene, poses = ab.Scene(device), np.tile(STILL, (15, 1))
    worlds = np.repeat(np.arange(5), 3)
    links = scene.add_many(sample("box"), poses, worlds).reshape(5, 3)
    post = scene.add(sample("box"), world=-1, static=True)
    scene.filter(links[:, [(0, 1), (1, 2)]])
    expected = [(a, b) for a, _, c in links.tolist() for b in (c, post)] + [(b, post) for b in links[:, 1].tolist()]
    expected += [(c, post) for c in links[:, 2].tolist()]
    np.testing.assert_array_equal(scene.broad_phase(), sorted(expected))
    assert scene.worlds.tolist() == [*worlds.tolist(), -1]


def test_distances_beyond_float32(device):
    """Objects out of float32's reach neither vanish nor hide the others."""
    poses = np.tile(STILL, (40, 1))
    poses[:, 0] = 0.75 * np.arange(40)
    poses[::4, 0] = 1e300
    poses[1::8, 1] = -1e200
    scene = make_scene(device, ["box"] * 40, poses)
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
        # The boxes' faces lie half a unit from their middles; only the first frame is off.
        scene = scene_with(device, (model, shrunk), (model, (order * (1 + gap / 2), 0, 0, 0, 0, 0, 1)))
        meets.append(scene.intersect([(0, 1)]).any[0])
        assert len(scene.broad_phase()) or not meets[-1]
        assert scene.intersect().any.any() == meets[-1]
    assert meets[0] and meets[2] and not meets[-1], meets
