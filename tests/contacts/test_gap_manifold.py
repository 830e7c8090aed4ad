"""Contact points with a gap: boxes in closed form, floors of many faces, and an order that steps do not change."""

import itertools

import numpy as np
import pytest
import trimesh
from helpers.bodies import FLOOR, about, box, model_of
from helpers.contacts import ask_points
from helpers.samples import STILL, random_poses, sample
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.checks.quaternions import multiply_quaternions

UP = [0, 0, 1.0]


@pytest.mark.parametrize("splits", [0, 3])
def test_a_tilted_box_has_points_inside_and_outside(device, splits):
    """An edge is in the floor, the one across from it apart: depths are minus the heights of corners."""
    floor, cube, tilt = box(4, 4, 1, splits=splits), box(1, 1, 1), 0.03
    pose = (0.01, 0.02, 0.5, *about((0, 1, 0), tilt))
    points = ask_points(device, (floor, FLOOR), (cube, pose), gap=0.05)[1].points
    r = quaternion_matrix(pose[3:])
    for x, y in itertools.product((-0.5, 0.5), repeat=2):
        corner = r @ [x, y, -0.5] + pose[:3]
        near = np.linalg.norm(points["point"] - corner, axis=1) < (0.05 if splits == 0 else 0.3)
        assert near.any() and np.abs(points["depth"][near] + corner[2]).min() < (1.5e-3 if splits == 0 else 0.01)
    assert points["depth"].max() == pytest.approx(-(r @ [0.5, 0.5, -0.5] + pose[:3])[2], rel=0.01)
    assert points["depth"].min() < -0.01
    assert (points["normal"] @ UP > 0.99).all()


def test_a_corner_over_a_face(device):
    pose = (0, 0, 0.5 + np.sqrt(0.75) + 0.01, *about((1, -1, 0), np.arctan(np.sqrt(2))))
    points = ask_points(device, (box(4, 4, 1), STILL), (box(1, 1, 1), pose), gap=0.02)[1].points
    assert points["depth"].max() == pytest.approx(-0.01, abs=1e-9)
    np.testing.assert_allclose(points["normal"], [UP] * len(points["normal"]), atol=1e-9)


@pytest.mark.parametrize("height", [-0.002, 0.001, 0.01])
def test_faces_ahead_on_a_floor_do_not_stop_what_slides(device, height):
    """Wherever the box is on a floor of many faces, deep in it or above, all points push upwards."""
    rng, floor, cube = np.random.default_rng(0), box(4, 4, 1, splits=4), box(0.7, 0.6, 0.5, splits=1)
    for _ in range(25):
        pose = (*rng.uniform(-1, 1, 2), 0.25 + height, *about(UP, rng.uniform(0, 3)))
        points = ask_points(device, (floor, FLOOR), (cube, pose), gap=0.06)[1].points
        assert len(points["normal"]) >= 4
        np.testing.assert_allclose(points["normal"], [UP] * len(points["normal"]), atol=0.05)


def test_the_deepest_point_is_kept(device):
    """Of balls that are apart it is as far as the distance says."""
    rng, ball = np.random.default_rng(1), sample("small ball")
    for pose in random_poses(rng, 12, 0.5):
        pose[:3] *= 2.03 / np.linalg.norm(pose[:3])
        query, result = ask_points(device, (ball, STILL), (ball, pose), pairs=[(0, 1)], gap=0.1)
        distance = query.batch and ab.DistanceQuery(query.batch, [(0, 1)]).run().distance[0]
        depth = result.points["depth"]
        assert 0 < len(depth) <= 8 and not result.any[0]
        assert distance * (1 - 1e-12) <= -depth.max() <= 0.1 * 0.1 + 0.9 * distance + 1e-12
        assert (depth > -0.1).all()


@pytest.mark.parametrize("rocks", [False, True])
def test_points_keep_their_order_while_a_box_slides(device, rocks):
    """Points that stay, as a box slides over the edges of a floor or rocks on it, come in the same order as before."""
    floor, cube = box(4, 4, 1, splits=4), box(0.7, 0.6, 0.5)
    scene = scene_with(device, (floor, FLOOR), cube)
    query, before, kept = ab.ManifoldQuery(scene, gap=0.02), None, 0
    for step in range(120):
        turned = about((0.002, 0.001, 1), 0.4 + 0.002 * step)
        place = np.array([-0.6 + 0.01 * step, 0.3 - 0.004 * step, 0.2495])
        if rocks:
            turned, place = about((np.sin(step), np.cos(2 * step), 0), 0.004), np.array([0.02, 0.03, 0.25])
        scene.set_poses([(0, 0, -0.5, 0, 0, 0, 1), (*place, *turned)])
        query.run()
        count = query.manifolds.count.numpy()[0]
        points = (query.manifolds.point.numpy()[0, :count] - place) @ quaternion_matrix(turned)
        if before is not None:
            away = np.linalg.norm(points[:, None] - before, axis=2)
            stay = away.min(1) < 0.004
            assert (np.diff(away.argmin(1)[stay]) >= 0).all()
            kept += stay.sum() / len(points)
        before = points
    assert kept > 40


@pytest.mark.parametrize("gap", [None, 0.05])
def test_same_bits_on_every_path(device, gap):
    rng, found = np.random.default_rng(2), []
    torus = model_of(trimesh.creation.torus(0.5, 0.2, 24, 12))
    placed = [(torus, pose) for pose in random_poses(rng, 9, 0.9)]
    for where, warps in (("cpu", False), (device, True), (device, None)):
        with testing.regime(warps=warps):
            points = ask_points(where, *placed, gap=gap)[1].points
        found.append([points[name].tobytes() for name in ("pair", "point", "normal", "depth")])
    assert found[0] == found[1] == found[2]
    assert (points["depth"] < 0).any() == (gap is not None) and (points["depth"] > 0).any()


SERVE = [(0.02, True), (0.043, True), (0.045, False), (0.06, False), (0.07, False)]


@pytest.mark.parametrize(("tilt", "serves"), SERVE)
def test_normals_serve_where_the_distance_is_nearly_along_them(device, tilt, serves):
    """Edges cross, and both faces fall away from them: the gap along either normal is the distance over a cosine."""
    height, rise = 0.1, np.tan(tilt)
    lower = ab.Model.from_arrays([[0, -1, 0], [0, 1, 0], [-1, 0, -rise]], [[0, 1, 2]], base_faces=1)
    upper = ab.Model.from_arrays([[-1, 0, height], [1, 0, height], [0, 1, height + rise]], [[1, 0, 2]], base_faces=1)
    points = ask_points(device, (lower, STILL), (upper, STILL), gap=0.2)[1].points
    assert points["depth"].max() == pytest.approx(-height / (np.cos(tilt) if serves else 1), rel=1e-9)
    assert points["normal"][0] @ UP == pytest.approx(np.cos(tilt) if serves else 1, abs=1e-9)


@pytest.mark.parametrize("named", [(0, 1), (1, 0)])
def test_edges_have_points_only_where_no_other_face_is_nearer(device, named):
    """Every witness of faces that are apart, by NumPy: its nearest points against all faces."""
    torus = model_of(trimesh.creation.torus(0.5, 0.2, 24, 12))
    poses = [(0, 0, 0, 0, 0, 0, 1), (0.6, 0.1, 0.43, *about((1, 2, 0.5), 0.4))]
    query = ask_points(device, *((torus, pose) for pose in poses), pairs=[named], gap=0.15)[0]
    count, near, witnesses = query.hits.witness_total.numpy()[0], query.near_contacts, query.witnesses
    items = query.witness_rows.item.numpy()[:count]
    depth, total = witnesses.depth.numpy()[:count], witnesses.nearest_total.numpy()[0]
    ends = near.p0.numpy()[:count], near.p1.numpy()[:count]
    vertices, faces, _ = torus.mesh_at(torus.lod_max)
    worlds = [(vertices @ quaternion_matrix(poses[i][3:]).T + poses[i][:3])[faces] for i in named]
    kept, dropped = 0, 0
    nearest_only = np.unique(witnesses.nearest_only.numpy()[:total])
    assert len(nearest_only) == total and (items[nearest_only, 0] >= 2**30).all()
    for w in nearest_only:
        nearest = np.inf
        for k in range(2):
            p = np.tile(ends[k][w], (len(faces), 1))
            at = trimesh.triangles.closest_point(worlds[1 - k], p)
            nearest = min(nearest, np.linalg.norm(at - p, axis=1).min())
        nearer = nearest / near.separation.numpy()[w]
        if np.isnan(depth[w]).all():
            assert nearer < 0.999001
            dropped += 1
        else:
            assert nearer > 0.998999
            kept += 1
    assert kept > 1 and dropped > 10


RESTS = {
    "cube": trimesh.creation.box().subdivide(),
    "cylinder": trimesh.creation.cylinder(0.5, 0.4, sections=16),
    "ring": trimesh.creation.annulus(0.3, 0.5, 0.3, sections=24),
    "ball": trimesh.creation.icosphere(1, 0.5),
    "spike": trimesh.creation.cone(0.1, 1, sections=8, transform=np.diag([1, -1, -1, 1])),
    "blade": trimesh.convex.convex_hull(
        np.array([[x, y, z] for x in (-0.5, 0.5) for y, z in ((-0.1, 0.8), (0.1, 0.8), (0, 0))])
    ),
}


@pytest.mark.parametrize("name", RESTS)
def test_points_of_what_merely_touches_push_upwards(device, name):
    """Faces, edges and corners on a floor, as near as rounding tells, whatever faces meet beside one another there.

    Which points are kept is decided in float32, of motions of twice the gap: 1e-8 is four of its roundings.
    """
    rng, mesh, floor, wrong = np.random.default_rng(0), RESTS[name], box(16, 8, 1, splits=2), []
    model = ab.Model.load(mesh, base_faces=len(mesh.faces))
    for height, whole, turn in itertools.product((0, 1e-17, 1e-15, 1e-12), (False, True), (0, 0, 0.7, 1)):
        q = rng.normal(size=4) if whole else np.array([0, 0, 0, 1.0])
        q, t = q / np.linalg.norm(q), whole * rng.uniform(-9, 9, 3)
        r, spin = quaternion_matrix(q), about(UP, turn)
        place = (0, 0, height - mesh.bounds[0, 2]) if turn < 1 else (*rng.uniform(-2, 2, 2), height - mesh.bounds[0, 2])
        poses = (*(r @ [0, 0, -0.5] + t), *q), (*(r @ place + t), *multiply_quaternions(q, spin))
        points = ask_points(device, (floor, poses[0]), (model, poses[1]), gap=0.01)[1].points
        up = points["normal"] @ r @ UP
        if len(up) == 0 or up.min() < 0.999 or abs(points["depth"].max() + height) > 1e-8:
            wrong.append((height, whole, turn, up, points["depth"]))
    assert not wrong


@pytest.mark.parametrize("splits", [0, 1])
@pytest.mark.parametrize("height", [0, 1e-9, 1e-6, 1e-4, 1e-3])
def test_what_overhangs_an_edge_is_held_by_all_corners(device, height, splits):
    """Of what two parallel rectangles share also the corners at which their edges cross, touching and apart."""
    rng, table, plank, wrong = np.random.default_rng(0), box(1, 1, 0.5, splits=splits), box(1.4, 0.3, 0.2), []
    for lower, upper in ((table, plank), (plank, table), (table, table)):
        low, high = (np.ptp(model.mesh_at(model.lod_max)[0], axis=0) / 2 for model in (lower, upper))
        for way in rng.uniform(-0.45, 0.45, (20, 2)):
            poses = STILL, (*way, low[2] + high[2] + height, 0, 0, 0, 1)
            found = ask_points(device, (lower, poses[0]), (upper, poses[1]), gap=0.01)[1].points["point"]
            ends = np.stack([np.maximum(-low[:2], way - high[:2]), np.minimum(low[:2], way + high[:2])])
            corners = np.array(list(itertools.product(*ends.T)))
            away = np.linalg.norm(found[:, None, :2] - corners, axis=2).min(0)
            if away.max() > 1e-6:
                wrong.append((way, corners, found))
    assert not wrong
