"""Contact points: depths and normals of boxes in closed form, area vectors against clipped faces, order and room."""

import itertools
import pathlib
import runpy

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.bodies import FLOOR, about, box, model_of
from helpers.contacts import ask_points
from helpers.questions import to_matrix
from helpers.samples import STILL, random_poses
from oracles.motion import posed
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.query.stages.points import make_twists


def clip_area_vector(half, pose, other_half, other_pose):
    """Area vector of that part of the faces of one box that lies within another, by clipping each face: an oracle."""
    r, r2 = quaternion_matrix(pose[3:]), quaternion_matrix(other_pose[3:])
    total, sides = np.zeros(3), list(itertools.product(range(3), (-1, 1)))
    for axis, sign in sides:
        corners = np.tile(sign * half.astype(float), (4, 1))
        corners[:, [axis - 2, axis - 1]] = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half[[axis - 2, axis - 1]]
        polygon = [r2.T @ (r @ corner + pose[:3] - other_pose[:3]) for corner in corners]
        for k, s in sides:
            kept = []
            for p, q in zip(polygon, polygon[1:] + polygon[:1]):
                at_p, at_q = other_half[k] - s * p[k], other_half[k] - s * q[k]
                if at_p >= 0:
                    kept.append(p)
                if (at_p < 0) != (at_q < 0):
                    kept.append(p + (q - p) * at_p / (at_p - at_q))
            polygon = kept
        for p, q in itertools.pairwise(polygon[1:]):
            total += 0.5 * sign * np.linalg.norm(np.cross(p - polygon[0], q - polygon[0])) * r[:, axis]
    return total


def check_upward(points, tolerance=1e-9):
    np.testing.assert_allclose(points["normal"] - [0, 0, 1.0], 0, atol=tolerance)


@pytest.mark.parametrize("splits", [(0, 0), (3, 0), (2, 2)])
@pytest.mark.parametrize(("height", "gap"), [(-0.01, None), (-0.01, 0.03), (0.0, 0.03), (0.01, 0.03)])
def test_a_box_at_a_floor_has_its_four_corners(device, splits, height, gap):
    floor, cube = box(4, 4, 1, splits=splits[0]), box(1, 0.8, 0.6, splits=splits[1])
    pose = (0.1, 0.2, 0.3 + height, *about((0, 0, 1), 0.3))
    points = ask_points(device, (floor, FLOOR), (cube, pose), gap=gap)[1].points
    check_upward(points, 1e-9 if gap else 1e-12)
    np.testing.assert_allclose(points["depth"], -height, atol=1e-12)
    for x, y in itertools.product((-0.5, 0.5), (-0.4, 0.4)):
        away = np.linalg.norm(points["point"] - posed(np.array([x, y, -0.3]), np.array(pose)), axis=1)
        # On faces of one another the place of a point is that of a column, one of many.
        coarse, fine = (0.02, 0.2) if gap else (1e-9, 0.15)
        assert away.min() < (coarse if splits == (0, 0) else fine)


@pytest.mark.parametrize(("depth", "gap"), [(0.02, None), (-0.02, 0.03)])
def test_edges_across_edges_push_along_their_cross_product(device, depth, gap):
    bar, half = box(4, 0.5, 0.5), np.sqrt(0.125)
    on_edge = quaternion_matrix(about((1, 0, 0), np.pi / 4))
    across = to_matrix(quaternion_matrix(about((0, 0, 1), np.pi / 2)) @ on_edge, [0, 0, 2 * half - depth])
    points = ask_points(device, (bar, to_matrix(on_edge, 0)), (bar, across), gap=gap)[1].points
    check_upward(points)
    assert points["depth"].max() == pytest.approx(depth, abs=1e-12 if gap else 1e-9)
    assert np.abs(points["point"][:, :2]).max() < 0.05


def boxes_at(*placed):
    parts = [trimesh.creation.box(extents).apply_translation(place) for extents, place in placed]
    return model_of(trimesh.util.concatenate(parts))


def test_a_corner_is_pushed_by_floor_and_walls_each_its_own_way(device):
    corner = boxes_at(((4, 4, 1), (0, 0, -0.5)), ((1, 4, 4), (-2.5, 0, 2)))
    _, result = ask_points(device, (corner, STILL), (box(1, 1, 1), (-1.51, 0.1, 0.495, 0, 0, 0, 1)))
    normals = result.points["normal"]
    up, aside = np.abs(normals - [0, 0, 1]).max(1) < 1e-9, np.abs(normals - [1, 0, 0]).max(1) < 1e-9
    assert up.sum() >= 2 and aside.sum() >= 2
    np.testing.assert_allclose(result.points["depth"][up], 0.005, atol=1e-9)
    assert result.points["depth"][aside].max() == pytest.approx(0.01, abs=1e-9)


@pytest.mark.parametrize("splits", [0, 2])
def test_a_loop_points_along_the_area_vector(device, splits):
    rng = np.random.default_rng(5)
    halves = np.array([0.5, 0.4, 0.3]), np.array([0.45, 0.35, 0.5])
    shapes = [box(*(2 * half), splits=splits) for half in halves]
    judged = 0
    for _ in range(25):
        poses = random_poses(rng, 2, 0.4)
        query, result = ask_points(device, *zip(shapes, poses))
        loops = query.curves.loop.numpy()[: result.count.sum()]
        area = clip_area_vector(halves[0], poses[0], halves[1], poses[1])
        if len(set(loops.tolist())) == 1 and np.linalg.norm(area) >= 1e-3:
            judged += 1
            found = query.curves.loop_normal.numpy()[loops[0]]
            np.testing.assert_allclose(found, area / np.linalg.norm(area), atol=1e-9)
    assert judged >= 8


def test_separate_contacts_are_separate_loops(device):
    """A table whose four legs stand in a floor, each on faces of its own; its normals point up at every leg."""
    legs = [(x, y) for x in (-1, 1) for y in (-1, 1)]
    table = boxes_at(*(((0.2, 0.2, 1), (x, y, 0.5)) for x, y in legs), ((3, 3, 0.2), (0, 0, 1.2)))
    tiles = boxes_at(*(((1.5, 1.5, 0.5), (x, y, -0.25)) for x, y in legs))
    query, result = ask_points(device, (tiles, STILL), (table, (0, 0, -0.01, 0, 0, 0, 1)))
    assert len(set(query.curves.loop.numpy()[: result.count[0]].tolist())) == 4
    points = result.points
    assert len(points["pair"]) == 4, "legs are boxes: what lies between their outermost corners adds nothing"
    assert len({tuple(np.sign(p[:2])) for p in points["point"]}) == 4, "the points are spread over all legs"
    check_upward(points)


@pytest.mark.parametrize("order", [1, -1])
def test_a_bar_that_jams_in_a_slot_is_pushed_by_each_wall_by_what_it_is_in_it(device, order):
    """Its sides cross both walls: two loops on faces that they share."""
    slot = boxes_at(((1, 4, 4), (-1, 0, 0)), ((1, 4, 4), (1, 0, 0)))
    placed = [(slot, STILL), (box(1.02, 0.9, 0.8), (0.002, 0.1, 0.2, 0, 0, 0, 1))][::order]
    query, result = ask_points(device, *placed)
    assert len(set(query.curves.loop.numpy()[: result.count[0]].tolist())) == 2
    normal, depth = order * result.points["normal"], result.points["depth"]
    for side in (1, -1):
        of_wall = np.abs(normal - [side, 0, 0]).max(1) < 1e-9
        assert of_wall.sum() >= 3
        np.testing.assert_allclose(depth[of_wall], 0.01 - 0.002 * side, atol=1e-9)


def test_a_nut_is_no_deeper_in_its_thread_than_it_was_moved(device):
    """From where it is free, by shifts and tilts of at most so much; loops run from flank to flank of the thread."""
    parts = runpy.run_path(str(pathlib.Path(__file__).parents[2] / "scenes/interop/newton_nut_and_bolt.py"))
    pitch, (vertices, faces) = parts["PITCH"], parts["make_nut"](16, 3)
    bolt, wide = ab.Model.from_arrays(*parts["make_bolt"](16, 8)), ab.Model.from_arrays(vertices, faces)
    middle = parts["find_height"](bolt, wide, pitch, 2 * pitch)
    nut = ab.Model.from_arrays(vertices * [0.975, 0.975, 1], faces)
    rng = np.random.default_rng(0)
    for moved in (0.0, 2.5e-4 / 3):
        scene = ab.Scene(device)
        for k in range(100):
            shift, tilt = rng.uniform(-1, 1, 3) * moved, rng.uniform(-1, 1, 2) * moved / 0.008
            turn = np.array([*tilt / 2, np.sin(np.pi * k / 16), np.cos(np.pi * k / 16)])
            height = middle + pitch * (k % 16) / 16 + shift[2]
            scene.add(bolt, static=True, world=k)
            scene.add(nut, (*shift[:2], height, *(turn / np.linalg.norm(turn))), world=k)
        result = ab.ManifoldQuery(scene, points=32).run()
        assert result.any.sum() == 0 if moved == 0 else result.any.sum() > 90
    way = moved * (np.sqrt(3) + np.sqrt(2) * np.hypot(1.05 * parts["RADIUS"], 3 * pitch) / 0.008)
    assert len(result.points["depth"]) > 1000 and result.points["depth"].max() < way


def test_apart_inside_and_touching(device):
    cube, small, sheet = box(1, 1, 1), box(0.2, 0.2, 0.2), ([[-2, -2, 0], [2, -2, 0], [0, 3, 0.0]], [[0, 1, 2]])
    _, inside = ask_points(device, (cube, STILL), (small, STILL), pairs=[(0, 1)])
    assert not inside.any[0] and len(inside.points["pair"]) == 0
    for depth in (0, 0.005):  # side on side
        _, touching = ask_points(device, (cube, STILL), (cube, (0, 0, 1 - depth, 0, 0, 0, 1)))
        assert touching.any[0] and len(touching.points["pair"]) >= 4
        check_upward(touching.points)
        np.testing.assert_allclose(touching.points["depth"], depth, rtol=0, atol=1e-9 * (depth > 0))
    _, flat = ask_points(device, (ab.Model.from_arrays(*sheet), STILL), (small, (0, 0, 0.09, 0, 0, 0, 1)))
    check_upward(flat.points)
    np.testing.assert_allclose(flat.points["depth"], 0.01, atol=1e-9)


@pytest.mark.parametrize("most", [8, 24])
def test_points_are_as_many_as_asked_for(device, most):
    """A ball in a cavity is near all around: more points leave smaller caps of directions without one, none twice."""
    ball, cavity = trimesh.creation.icosphere(2, 1.0), trimesh.creation.icosphere(2, 1.01)
    cavity.invert()
    shell = ab.Model.from_arrays(cavity.vertices, cavity.faces)
    with pytest.warns(RuntimeWarning, match="inside out"):
        points = ask_points(device, (model_of(ball), STILL), (shell, STILL), gap=0.02, points=most)[1].points
    for none in (0, 65, 2.5, "8"):
        refused(ValueError, "points", ab.ManifoldQuery, ab.Scene(device), points=none)
    normals = points["normal"]
    assert most - 1 <= len(normals) <= most  # the last place is the deepest's, if it is deeper
    seen = (normals @ np.asarray(ball.vertices).T).max(0).min()  # cosine of the emptiest cap
    # What is pushed anywhere is held within that angle; and 24 do what no 8 can, 48 degrees.
    assert seen > {8: -0.11, 24: 0.67}[most]
    places = np.hstack([points["point"], normals])
    away = np.linalg.norm(places[:, None] - places, axis=2)
    assert (away + 2 * np.eye(len(places))).min() > 0.05


def turn_twists(turns, n, wrench):
    """Return turns about lines at the rim of wrenches across a normal, in 32 directions, (6, 32)."""
    axis = np.abs(n).argmin()
    u = np.cross(n, np.eye(3)[axis])
    u /= np.linalg.norm(u)
    directions = turns[0][:, None] * u + turns[1][:, None] * np.cross(n, u)
    angular = np.cross(n, directions)
    reach = 0.95 * (-wrench[:, 3:] @ angular.T).max(0)
    twists = np.hstack([reach[:, None] * n, angular])
    return (twists / np.linalg.norm(twists, axis=1)[:, None]).T


def choose_plainly(x, normal, depth, gap, most):
    """Return which candidates stand for a pair, by the twists that go deepest past those before, an oracle."""
    low, high = x.min(0), x.max(0)
    size, deepest = np.linalg.norm(high - low) / 2, depth.max()
    wrench = np.hstack([normal, np.cross((x - (low + high) / 2) / size, normal)])
    against = normal[(normal @ normal[depth.argmax()]).argmin()]
    twists = make_twists().reshape(6, -1).astype(float)
    turns = [turn_twists(twists[:, 192:224], n, wrench) for n in (normal[depth.argmax()], against)]
    twists = np.hstack([twists[:, :192], *turns])
    separation, rate = max(deepest, 0.0) - depth, wrench @ twists
    limit, taken = 2 * (gap + max(deepest, 0.0)) + size / 256, []
    stop = np.full(twists.shape[1], limit)
    while len(taken) < most:
        past = -(separation[:, None] + rate * stop).min(1)
        spent = past.max() <= limit / 1024
        if (spent or len(taken) == most - 1) and (0.9 * (deepest + gap) > depth[taken].max(initial=-np.inf) + gap):
            return [*taken, depth.argmax()]
        if spent:
            return taken
        taken.append(past.argmax())
        closing = np.maximum(-rate[taken[-1]], 1e-300)
        stop = np.minimum(stop, np.where(closing > 2**-20, separation[taken[-1]] / closing, np.inf))
    return taken


@pytest.mark.parametrize("most", [8, 32])
@pytest.mark.parametrize("gap", [None, 0.1])
def test_points_are_those_of_a_plain_choice(device, gap, most):
    torus, counts = model_of(trimesh.creation.torus(0.5, 0.2, 24, 12)), []
    for k, height in enumerate((0.1, 0.2, 0.33)):
        shifts = (0, 0, 0), (0.3, 0.1, height)
        placed = [(torus, (*shift, *about((1, 2, k), 0.5 + j + k))) for j, shift in enumerate(shifts)]
        query, result = ask_points(device, *placed, gap=gap, points=most)
        witnesses, along = query.witnesses, [0.6134, 0.5327, 0.5831]
        count = query.hits.witness_total.numpy()[0]
        depth = witnesses.depth.numpy()[:count]
        i = np.nonzero(depth >= -(gap or 0.0))
        x, normal = witnesses.point.numpy()[:count][i], witnesses.normal.numpy()[:count][i[0]]
        turn = quaternion_matrix(placed[0][1][3:])
        taken = choose_plainly(x @ turn, normal @ turn, depth[i], gap or 0.0, most)
        expected = x[taken][np.argsort(x[taken] @ (turn @ along))]
        # Of corners in one place float32 may take another than float64.
        np.testing.assert_allclose(result.points["point"], expected, atol=1e-9)
        counts.append(len(taken))
    assert max(counts) == most or max(counts) > 12, counts


def test_motions_beyond_float32_choose_points(device):
    """Within a gap whose double is infinite there: as many as within half of it, not those few of the first motion."""
    ball = model_of(trimesh.creation.icosphere(subdivisions=2, radius=2e29))
    placed = (ball, STILL), (ball, (1e38, 1e38, 1e38, 0, 0.6, 0, 0.8))
    counts = [len(ask_points(device, *placed, gap=gap, points=64)[1].points["depth"]) for gap in (1.74e38, 3e38)]
    assert counts == [64, 64]
