"""Contact points between launches: which pairs rest, what they keep, and that nothing is kept that should not be."""

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.bodies import FLOOR, about, box
from helpers.samples import sample
from helpers.scenes import scene_with
from oracles.motion import posed
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.checks.quaternions import multiply_quaternions

GAP, REST = 0.08, 0.01


def see(pose, points):
    return (np.asarray(points) - pose[:3]) @ quaternion_matrix(pose[3:])


def at(x, y, z):
    return (x, y, z, 0, 0, 0, 1.0)


def near_rest(rng, away=0.0, angle=0.0):
    """Return a pose near that of a cube on the floor, off by so much."""
    return np.array([*(rng.normal(size=3) * away + [0, 0, 0.49]), *about(rng.normal(size=3), angle)])


def make(device, mesh=None, pairs=((0, 1),), remember=REST, **options):
    scene = scene_with(device, (box(4, 4, 1, splits=3), FLOOR), box(1, 1, 1) if mesh is None else mesh)
    return scene, ab.ManifoldQuery(scene, pairs and np.array(pairs), gap=GAP, remember=remember, **options)


def is_resting(query):
    return query.memory.place.numpy()[: int(query.pair_count.numpy()[0])] >= 0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_points_of_a_pair_that_rests_move_with_its_objects(device, order):
    """Each is the middle of what was one point of either, less deep as these come apart: in NumPy, both move."""
    rng, (scene, query) = np.random.default_rng(0), make(device, pairs=[order])
    for _ in range(20):
        floor, cube = np.array(FLOOR, float), near_rest(rng, 0.01, 0.02)
        scene.set_poses([floor, cube])
        query.forget()
        first = query.run().points
        assert not is_resting(query)[0] and len(first["depth"]) >= 3
        carry = np.array([*rng.normal(size=3), *about(rng.normal(size=3), 1.0)])  # both, together
        shift = rng.normal(size=3)
        cube_now = cube + [*(0.9 * REST * rng.random() * shift / np.linalg.norm(shift)), 0, 0, 0, 0]
        now = [[*(posed(x[None, :3], carry)[0]), *multiply_quaternions(carry[3:], x[3:])] for x in (floor, cube_now)]
        scene.set_poses(now)
        points = query.run().points
        assert is_resting(query)[0] and query.hits.count.numpy()[0] == 0
        of_floor = posed(see(floor, first["point"]), np.array(now[0]))
        of_cube = posed(see(cube, first["point"]), np.array(now[1]))
        normal = first["normal"] @ quaternion_matrix(carry[3:]).T
        np.testing.assert_allclose(points["normal"], normal, atol=1e-12)
        np.testing.assert_allclose(points["point"], (of_floor + of_cube) / 2, atol=1e-12)
        apart = of_cube - of_floor if order == (0, 1) else of_floor - of_cube
        depth = first["depth"] - np.einsum("ij,ij->i", apart, normal)
        np.testing.assert_allclose(points["depth"], depth, atol=1e-12)


@pytest.mark.parametrize("distance", [True, 0.002])
@pytest.mark.parametrize("lower", [0, 1])
def test_a_pair_rests_while_no_corner_has_moved_farther(device, distance, lower):
    """Turns about far and near axes, and shifts: by the corners of the smaller object's box, in NumPy."""
    rng, floor, cube = np.random.default_rng(1), box(4, 4, 1, splits=2), box(0.7, 0.6, 0.5)
    still, start = np.array(FLOOR, float), np.array([0.1, 0.2, 0.25, *about((0, 0, 1), 0.3)])
    scene = scene_with(device, *([(floor, FLOOR), cube] if lower == 0 else [cube, (floor, FLOOR)]))
    query = ab.ManifoldQuery(scene, [(0, 1)], gap=GAP, remember=distance)
    size = 0.5 * np.linalg.norm([0.7, 0.6, 0.5])
    limit = distance if distance is not True else min(GAP / 8, size / 2048)
    corners = np.array(np.meshgrid(*([-1, 1],) * 3)).reshape(3, 8).T * [0.35, 0.3, 0.25]
    seen = set()
    for _ in range(60):
        scene.set_poses([still, start] if lower == 0 else [start, still])
        query.forget()
        query.run()
        shift, axis = rng.normal(size=3), rng.normal(size=3)
        turn = np.array([0, 0, 0, *about(axis, rng.normal() * limit)])
        place = posed(start[None, :3], turn)[0] + 0.5 * limit * shift
        pose = np.array([*place, *multiply_quaternions(turn[3:], start[3:])])
        moved = np.linalg.norm(posed(corners, pose) - posed(corners, start), axis=1).max()
        if abs(moved / limit - 1) < 1e-4:  # root boxes are in float32
            continue
        scene.set_poses([still, pose] if lower == 0 else [pose, still])
        query.run()
        assert is_resting(query)[0] == (moved < limit)
        seen.add(bool(moved < limit))
    assert seen == {False, True}


def test_slow_motions_add_up(device):
    """Steps of a fifth of the distance: every sixth launch searches, and its points are those of a first launch."""
    scene, query = make(device)
    fresh = ab.ManifoldQuery(scene, [(0, 1)], gap=GAP)
    rested = []
    for k in range(18):
        scene.set_poses([FLOOR, (0.21 * REST * k, 0, 0.49, *about((0, 0, 1), 0.2))])
        points = query.run().points
        rested.append(bool(is_resting(query)[0]))
        if not rested[-1]:
            others = fresh.run().points
            assert points.keys() == {*others.keys(), "before"}
            for name, values in others.items():
                assert np.ascontiguousarray(values).tobytes() == np.ascontiguousarray(points[name]).tobytes()
    assert rested == [k % 5 != 0 for k in range(18)]


def test_points_know_their_place_in_the_launch_before(device):
    """Of pairs that rest and of those that are searched: mutual nearest points, in NumPy, as objects have moved."""
    rng, (scene, query) = np.random.default_rng(6), make(device)
    reach, pose, last, kinds = 2.0**-5 * 0.5 * 3**0.5, near_rest(rng, 0.01, 0.02), None, set()
    for step in range(40):
        scene.set_poses([FLOOR, pose])
        points = query.run().points
        if last is None:
            expected = np.full(len(points["depth"]), -1)
        else:
            # Where each of the last launch is now: the middle of what moved with either.
            moved = 0.5 * (last[1] + posed(see(last[0], last[1]), pose))
            far = np.linalg.norm(points["point"][:, None] - moved[None], axis=2)
            alike = (points["normal"] @ last[2].T > 0.5) & (far < reach)
            # That the nearest of a place may be a point of another normal counts, too.
            nearest = np.where(alike, far, np.inf).argmin(1)
            found = alike.any(1) & (far.argmin(0)[nearest] == np.arange(len(far)))
            expected = np.where(found, nearest, -1)
        resting = bool(is_resting(query)[0])
        if not resting or step == 0:
            assert points["before"].tolist() == expected.tolist()
        else:
            # As many points as before or fewer, in their order, those that are a gap apart gone.
            assert (np.diff(points["before"]) > 0).all() and (points["before"] >= 0).all()
            np.testing.assert_allclose(points["point"], moved[points["before"]], atol=2 * REST)
        kinds.add((resting, bool((points["before"] < 0).any())))
        last = pose.copy(), points["point"], points["normal"]
        pose = pose.copy()
        pose[:2] += rng.normal(size=2) * (0.2 * REST if step % 3 else 2 * REST)
        pose[3:] = multiply_quaternions(about(rng.normal(size=3), 0.001), pose[3:])
    assert {(True, False), (False, False), (False, True)} <= kinds
    query.forget()
    assert (query.run().points["before"] == -1).all()


def test_lods_gaps_and_pairs_that_are_others_are_searched(device):
    scene = scene_with(device, (box(4, 4, 1, splits=3), FLOOR), sample("small ball"), (box(1, 1, 1), at(3, 0, 0.5)))
    scene.set_poses([FLOOR, at(0, 0, 1.0), at(1.5, 0, 0.49)])
    query = ab.ManifoldQuery(scene, [(0, 1), (0, 2)], gap=GAP, remember=REST)
    query.run()
    query.run()
    assert is_resting(query).tolist() == [True, True]
    scene.set_lods([scene.models[0].lod_max, 40, scene.models[2].lod_max])
    query.run()
    assert is_resting(query).tolist() == [False, True]
    query.set_pairs([(0, 1), (1, 2)])
    query.run()
    assert is_resting(query).tolist() == [True, False]
    query.set_pairs([(0, 1), (1, 2)], gap=GAP + 2 * REST)
    query.run()
    assert is_resting(query).tolist() == [False, False]
    query.set_pairs([(0, 1), (1, 2)], gap=GAP)
    query.run()
    assert is_resting(query).tolist() == [True, True]
    query.forget()
    query.run()
    assert is_resting(query).tolist() == [False, False]


def test_pairs_of_the_broad_phase_are_found_again_in_other_places(device):
    """Bodies that come and go shift the places of pairs; those that stay rest, and have their own points."""
    bodies = [(box(0.5, 0.5, 0.5), at(k, 0, 0.245)) for k in range(5)]
    scene = scene_with(device, *bodies[:2], (box(9, 9, 1), FLOOR), *bodies[2:])
    poses = [[k, 0, 0.245, *about((0, 0, 1), 0.1 * k)] for k in range(5)]
    poses.insert(2, list(map(float, FLOOR)))
    rng, query = np.random.default_rng(3), ab.ManifoldQuery(scene, gap=GAP, remember=REST)
    fresh, places, before = ab.ManifoldQuery(scene, gap=GAP), set(), set()
    for _ in range(12):
        away = rng.random(6) < 0.4
        away[2] = False
        asked = np.array(poses)
        asked[away, 2] += 5
        scene.set_poses(asked)
        result, found = query.run(), fresh.run()
        np.testing.assert_array_equal(result.pairs, found.pairs)
        np.testing.assert_array_equal(result.any, found.any)
        np.testing.assert_array_equal(result.points["pair"], found.points["pair"])
        np.testing.assert_allclose(result.points["point"], found.points["point"], atol=1e-13)
        resting, pairs = is_resting(query), [tuple(pair) for pair in result.pairs.tolist()]
        assert resting.tolist() == [pair in before for pair in pairs]
        before = set(pairs)
        places |= set(zip(query.memory.place.numpy()[: len(resting)][resting], np.flatnonzero(resting)))
    assert any(there != here for there, here in places)


def test_a_launch_that_lost_something_is_forgotten(device):
    scene, query = make(device, mesh=sample("small ball"), capacity=ab.Buffers(hits=1))
    scene.set_poses([FLOOR, at(0, 0, 0.95)])
    query.launch()
    with pytest.raises(ab.CapacityError):
        query.result(with_points=False).check()
    query.launch()
    assert not is_resting(query)[0]
    query.run()
    query.run()
    assert is_resting(query)[0]


def test_room_that_grows_keeps_what_is_known(device):
    """Other bodies come: there is more room for hits and pairs, and the pair that was there still rests."""
    balls = [(sample("small ball"), at(5.0 * k, 0, 9.0)) for k in range(4)]
    scene = scene_with(device, (box(4, 4, 1, splits=3), FLOOR), (box(1, 1, 1), at(0, 0, 0.49)), *balls)
    query = ab.ManifoldQuery(scene, capacity=ab.Buffers(hits=720, pairs=1), gap=GAP, remember=REST)
    before = query.run().points
    room = query.rooms
    scene.set_poses([FLOOR, at(0, 0, 0.49), *(at(k % 2, k // 2, 0.9) for k in range(4))])
    result = query.run()
    assert query.rooms.hits > room.hits and query.rooms.pairs > room.pairs
    assert is_resting(query).sum() == 1 and is_resting(query)[0] and len(result.pairs) > 5
    np.testing.assert_allclose(result.points["point"][result.points["pair"] == 0], before["point"], atol=1e-13)


def test_what_touches_without_a_gap_keeps_its_points(device):
    scene = scene_with(device, (box(4, 4, 1, splits=3), FLOOR), (box(1, 1, 1), at(0.1, 0.2, 0.5)))
    query = ab.ManifoldQuery(scene, [(0, 1)], gap=0.0, remember=REST)
    first, again = query.run().points, query.run().points
    assert is_resting(query)[0] and len(first["depth"]) == len(again["depth"]) > 0


def test_solids_keep_whether_they_hold_one_another(device):
    """A ball inside a solid: no face crosses, and the pair that rests still says so, with the points that it had."""
    scene = scene_with(device, (box(4, 4, 4), {"solid": True}), (sample("small ball"), at(1.2, 0, 0)))
    query = ab.ManifoldQuery(scene, [(0, 1)], gap=GAP, remember=REST)
    first, again = query.run(), query.run()
    assert first.any[0] and again.any[0] and is_resting(query)[0]
    assert len(first.points["depth"]) > 0
    np.testing.assert_allclose(again.points["depth"], first.points["depth"], atol=1e-12)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="a graph needs a GPU")
def test_a_graph_remembers():
    scene, query = make("cuda:0")
    scene.set_poses([FLOOR, at(0, 0, 0.49)])
    query.run()
    query.forget()
    with wp.ScopedCapture("cuda:0") as capture:
        query.launch()
    for k in range(3):
        wp.capture_launch(capture.graph)
        assert is_resting(query)[0] == (k > 0)


def run_walk(device):
    rng, (scene, query) = np.random.default_rng(5), make(device, pairs=None)
    pose, found = np.array([0, 0, 0.49, 0, 0, 0, 1.0]), []
    for k in range(24):
        step = rng.normal(size=3) * (0.2 if k % 7 == 0 else 0.3 * REST)
        pose[:3] += [step[0], step[1], 0.02 * step[2]]
        pose[3:] = multiply_quaternions(about(rng.normal(size=3), 0.001), pose[3:])
        scene.set_poses([FLOOR, pose])
        points = query.run().points
        found.append(is_resting(query).tobytes() + b"".join(np.ascontiguousarray(x).tobytes() for x in points.values()))
    return found


def test_the_same_bits_on_every_device():
    found = [run_walk(str(device)) for device in wp.get_devices()]
    with testing.regime(warps=True):
        found.append(run_walk("cpu"))
    assert all(other == found[0] for other in found)
    assert len({walk[:1] for walk in found[0]}) == 2


def test_what_remember_takes(device):
    scene = scene_with(device, (box(4, 4, 1), FLOOR), box(1, 1, 1))
    for wrong in (0.0, -1.0, np.nan, np.inf, "yes", (1.0, 2.0)):
        refused(ValueError, "remember", ab.ManifoldQuery, scene, gap=GAP, remember=wrong)
    refused(ValueError, "remember: needs a gap", ab.ManifoldQuery, scene, remember=True)
    assert ab.ManifoldQuery(scene, gap=GAP, remember=np.True_).memory is not None
    for off in (None, False, np.False_):
        query = ab.ManifoldQuery(scene, gap=GAP, remember=off)
        query.forget()
        assert query.memory is None
