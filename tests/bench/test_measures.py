"""The measures of benchmarks and studies on cases known by hand."""

import math

import numpy as np
import pytest
import trimesh

import warp_abtree as ab
from bench import timing
from bench.cases.update import bound_nodes
from bench.contacts import points
from bench.shapes import scene_of_poses
from bench.studies.motions import Motions, find_first_contact
from bench.studies.paper import update
from bench.studies.tradeoff import regions, summaries, workload
from warp_abtree.query.result import contact_dtypes

pytestmark = pytest.mark.slow


def test_fits():
    assert timing.fit_slope([1, 10, 100], [2.0, 20.0, 200.0]) == 1 and timing.fit_slope([3], [1.0]) is None
    x, excess = np.array([1, 10, 80, 125, 1000]), np.log(np.array([1, 10, 80, 125, 1000]) / 100)
    found = [timing.crossover(x[some], excess[some], 0.0) for some in (slice(5), slice(3), slice(3, 5))]
    assert found == [pytest.approx(100), None, 0.0]
    # Times that are 3 ns a node of equation (1) give that back, and the crossover with a flat full refit.
    assert bound_nodes(1, 1024) == 11 and bound_nodes(1024, 1024) == 2047 and bound_nodes(0, 5) == 0
    rows = []
    for fraction in np.geomspace(0.001, 1, 40):
        k = fraction * 1000
        bound = bound_nodes(k, 1000)
        row = {"case": "move", "model": "m", "faces": 1000, "splits": 1, "k": k, "share": fraction, "nodes": bound / 2}
        rows.append(row | {"bound": bound, "refit_ms": 3e-6 * bound, "full_ms": 3e-6 * 1200, "from_finest": True})
    (fit,) = update.fit_figure_6(rows)
    assert fit["ns_a_node"] == pytest.approx(3.0) and fit["correlation"] == pytest.approx(1.0)
    assert bound_nodes(1000 * fit["crossover"], 1000) == pytest.approx(1200, rel=0.02)
    assert update.fitted_moves(rows)[7]["fitted_ms"] == pytest.approx(rows[7]["refit_ms"])


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_first_contact_of_boxes(device, offset):
    """Cubes of side 1 meet where their centres are 1 apart, wherever B's own origin is."""
    box = trimesh.creation.box()
    model, moved = (ab.Model.from_arrays(box.vertices + x, box.faces, base_faces=12) for x in (0, offset))
    motions = Motions(np.random.default_rng(0), 3, model, moved)
    motions.away[:] = np.eye(3)
    motions.rotations[:] = 0, 0, 0, 1

    def intersects(poses):
        return ab.sweep(model, moved, poses, device=device)

    low, high = find_first_contact(intersects, motions, steps=50)
    assert low == pytest.approx([1, 1, 1], abs=1e-9) and (high >= low).all()
    assert intersects(motions.poses(low)).all() and not intersects(motions.poses(high)).any()
    low, high = find_first_contact(lambda poses: poses[:, 0] + offset > 0.4, motions, steps=16)
    assert not np.isnan(low[0]) and np.isnan(low[1:]).all() and np.isnan(high[1:]).all()
    assert workload.judge_contact(low - 1)["never"] == 2


def test_judged_answers_and_front():
    found = workload.judge_answers(np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 1, 0, 1], bool))
    assert (found["missed"], found["invented"]) == (1, 1)
    assert found["precision"] == found["recall"] == pytest.approx(2 / 3)
    assert workload.judge_answers(np.zeros(2, bool), np.zeros(2, bool))["recall"] is None
    error = workload.judge_contact(np.array([0.1, -0.3, np.nan]))
    assert error["contact_mean"] == pytest.approx(0.2) and error["contact_max"] == pytest.approx(0.3)
    assert (error["early_max"], error["late_max"], error["never"]) == (pytest.approx(0.1), pytest.approx(0.3), 1)
    assert workload.judge_contact(np.array([np.nan]))["contact_mean"] is None
    points = [(1, 5), (2, 3), (2, 4), (3, 3), (4, 0), (1, 5)]
    assert workload.find_front(*zip(*points, strict=True)) == [True, True, False, False, True, True]


def make_contacts(rows):
    """Contacts of (pose, p0, p1)."""
    contacts = np.zeros(len(rows), contact_dtypes()[0])
    for contact, (pose, p0, p1) in zip(contacts, rows, strict=True):
        contact["pair"], contact["p0"], contact["p1"] = pose, p0, p1
    return contacts


def compare(found, truth, poses, size=1.0):
    return regions.compare_regions(*(regions.make_regions(make_contacts(x), poses, size) for x in (found, truth)))


def test_regions_of_lines():
    """Two poses with lines 0.005 and 0.3 apart; a third where one region is missing; one region half of another."""
    truth = [(0, (0, 0, 0), (1, 0, 0)), (1, (0, 0, 0), (2, 0, 0)), (2, (0, 0, 0), (1, 0, 0))]
    found = [(0, (0, 0.005, 0), (1, 0.005, 0)), (1, (0, 0, 0.3), (2, 0, 0.3))]
    row = compare(found, truth, 3)
    assert row["contacts_missed"] == pytest.approx(2 / 3) and row["contacts_invented"] == 0.5
    assert [row["region_mean"], row["region_hausdorff"]] == pytest.approx([0.1525] * 2)
    assert row["region_hausdorff_max"] == pytest.approx(0.3)
    scaled = compare(found, truth, 3, 10.0)
    assert scaled["region_mean"] == pytest.approx(row["region_mean"] / 10), "distances are parts of the size"
    same = compare(truth, truth, 3)
    assert same["contacts_missed"] == same["region_hausdorff_max"] == 0
    # Nothing is far from the half one way, and the mean the other way is an eighth.
    whole, half = [(0, (0, 0, 0), (1, 0, 0))], [(0, (0, 0, 0), (0.5, 0, 0))]
    for row in (compare(half, whole, 1), compare(whole, half, 1)):
        assert row["region_mean"] == pytest.approx(0.125, rel=1e-3)
        assert row["region_hausdorff"] == pytest.approx(0.5, rel=1e-2)


def test_distances_equal_brute_force():
    rng = np.random.default_rng(0)
    rows = [(int(rng.integers(3)), *rng.normal(size=(2, 3)) * 0.2 + rng.normal(size=3)) for _ in range(40)]
    rows.append((3, (5, 5, 5), (5, 5, 5)))  # a pose of one sample, whose nearest four are of other poses
    other = regions.make_regions(make_contacts(rows), 5, 1.0)
    points, pose = rng.normal(size=(60, 3)), rng.integers(0, 5, 60)
    expected = regions.segment_distance(points[:, None], other.ends[None])
    expected[pose[:, None] != other.pose] = np.inf
    found = regions.distances(points, pose, other)
    np.testing.assert_allclose(found, expected.min(1), rtol=1e-3)
    assert np.isinf(found[pose == 4]).all() and np.isfinite(found[pose < 4]).all()
    point = np.array([[0.0, 3, 0]])
    assert regions.segment_distance(point, np.array([[[1.0, 0, 0], [1.0, 0, 0]]])) == pytest.approx(math.sqrt(10))


def test_normals():
    pairs = np.zeros((2, 3), contact_dtypes()[1])
    pairs["count"] = [[1, 1, 0], [2, 1, 1]]
    pairs["normal"] = [[(1, 0, 0), (0, 0, 1), (np.nan,) * 3], [(0, 1, 0), (0, 0, 1), (0, 0, 1)]]
    row = regions.compare_normals(*pairs, np.array([False, True, True]))
    assert row["normal_mean"] == pytest.approx(45) and row["normal_clear_mean"] == pytest.approx(0)
    # Normals that agree, that cancel, weighted by length, and a pose without contacts.
    contacts = make_contacts([(0, (0, 0, 0), (1, 0, 0)), (0, (0, 0, 0), (3, 0, 0)), (2, (0, 0, 0), (1, 0, 0))])
    contacts["normal"] = (0, 0, 1), (0, 0, -1), (0, 1, 0)
    assert regions.resultants(contacts, 4).tolist() == [0.5, 0, 1, 0]


def test_means_over_workloads():
    rows = [{"share": s, "e": e} for s, e in ((1, 0), (0.5, 0.1), (0.2, 0.3), (0.1, 0.2), (0.01, None))]
    assert [summaries.cheapest(rows, "e", limit)["share"] for limit in (0, 0.1, 0.25, 0.3)] == [1, 0.5, 0.5, 0.1]
    rows = [{"workload": name, "value": 1, "poses": 4, "meet": 2, "missed": 1, "invented": 0} for name in "ab"]
    rows[0] |= {"cost": 1.0, "early_max": 0.1, "bound": 1.0}
    rows[1] |= {"cost": 4.0, "early_max": 0.3, "bound": 2.0}
    (row,) = summaries.summarise(rows, ["value"])
    assert (row["poses"], row["recall"], row["precision"], row["workloads"]) == (8, 0.5, 1.0, 2)
    assert (row["cost"], row["early_max"], row["bound"]) == (pytest.approx(2.0), 0.3, 1.5)


def corners_at(separations):
    """Return contacts at the corners of a square of side 2 over a floor."""
    corners = np.array([(-1.0, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)])
    return points.Contacts(corners, np.tile([0, 0, 1.0], (4, 1)), np.array(separations))


def test_depth_of_meshes_that_are_moved():
    """A cube goes as deep into a larger one as it moves beyond the gap; where all points block, no deeper."""
    boxes = [trimesh.creation.box((size, size, size)) for size in (2.0, 1.0)]
    parts = [ab.Model.from_arrays(mesh.vertices, mesh.faces) for mesh in boxes]
    (lods, start), height = ([part.lod_max for part in parts], 0.3 * points.GAP), 1.5
    pose = np.eye(4)
    pose[2, 3] = height + start
    first, second = points.sides(parts, lods, pose)
    assert len(first.vertices) == 4 and len(second.vertices) == 0  # no corner of the larger one is near
    ways = points.GAP * np.array([0.1, 0.3, 0.7, 1.0])
    down = [points.moved_along(np.array([0, 0, -way, 0, 0, 0]), np.zeros(3)) for way in ways]
    np.testing.assert_allclose(first.depths(down), np.maximum(ways - start, 0), atol=1e-12)
    tilted = points.moved_along(np.array([0, 0, 0, 1e-4, 0, 0]), np.array([0, 0, height + start - 0.5]))
    np.testing.assert_allclose(tilted[:3, :3], [[1, 0, 0], [0, 1, -1e-4], [0, 1e-4, 1]], atol=1e-8)
    np.testing.assert_allclose(first.depths([tilted]), 0.5e-4 - start, rtol=1e-3)
    scene, pairs = scene_of_poses("cpu", *parts, [pose])
    near = scene.intersect(pairs, "contacts", gap=points.GAP)
    found = ab.ManifoldQuery(scene, pairs, gap=points.GAP, points=16).run()
    row = points.push(parts, lods, [pose], near, found, 40)
    assert row["really_um"] < 1e-3 and 0 < row["all_moved_um"] <= row["moved_um"] + 1e-9 < 1e6 * points.GAP
    found.points["normal"][:] *= -1  # nothing blocks what goes down
    assert points.push(parts, lods, [pose], near, found, 40)["really_um"] > 5


def prism(outline, caps):
    """Return a model over an outline, from 0 to 1, and the side of it that points near it lie on."""
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, np.ones(n)]])
    walls = [f for i in range(n) for j in [(i + 1) % n] for f in ((i, j, j + n), (i, j + n, i + n))]
    model = ab.Model.from_arrays(vertices, np.concatenate([np.array(caps)[:, ::-1], np.array(caps) + n, walls]))
    cube = ab.Model.load(trimesh.creation.box((0.1, 0.1, 0.1)))
    return next(iter(points.sides([model, cube], [model.lod_max, cube.lod_max], np.eye(4))))


def test_the_side_of_a_mesh_off_its_edges_and_corners():
    """By the normals of both faces at an edge, and of all at a corner: of an L, and off the sharp edge of a wedge."""
    gap, x, y = points.GAP, 0.3 * points.GAP, 0.4 * points.GAP
    ell = prism([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2.0)], [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)])
    near = [(1 - x, 1 - y, 0.5), (1 + x, 1 + y, 0.5), (2 + x, 1 + y, 0.5), (2 - y, 1 - x, 0.5), (1 - x, 1 - y, 1 + y)]
    np.testing.assert_allclose(ell.distances(np.array(near)) / gap, [-0.5, 0.3, 0.5, -0.3, 0.4], rtol=1e-6)
    corner = np.array([(2 + x, 1 + y, 1 + x), (-x, -y, -x)])
    np.testing.assert_allclose(ell.distances(corner), np.hypot(0.5 * gap, x), rtol=1e-6)
    # Behind one of both planes, but outside; and at the corner behind one of three.
    wedge = prism([(0, 0), (2, 0), (2, 0.3)], [(0, 1, 2)])
    off = np.array([(-0.5 * gap, way * gap, z) for way in (-0.2, 0.2) for z in (0.5, 1 + 0.1 * gap, -0.1 * gap)])
    assert (wedge.distances(off) > 0.5 * gap).all()


def test_penetration_that_points_allow():
    """Four corners allow none; their middle alone lets a square tilt about it, none at all lets it through."""
    gap, square = 0.1, corners_at([0.02, 0.0, 0.05, 0.03])
    assert np.abs(points.penetration_allowed(square, square, gap)).max() < 1e-15
    twists, centre = points.random_twists(square)
    assert np.allclose(np.linalg.norm(twists * [1, 1, 1, 2**0.5, 2**0.5, 2**0.5], axis=1), 1) and not centre.any()
    rates = twists[:, 2:3] + twists[:, 3:4] * square.point[:, 1] - twists[:, 4:5] * square.point[:, 0]
    middle = points.Contacts(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([0.02]))
    goes = np.where(twists[:, 2] < 0, np.minimum(2 * gap, 0.02 / np.abs(twists[:, 2])), 2 * gap)
    for kept, way in ((middle, goes), (points.Contacts(*(part[:0] for part in square)), 2 * gap + 0 * goes)):
        expected = np.maximum(0, -(square.separation + rates * way[:, None]).min(1))
        np.testing.assert_allclose(points.penetration_allowed(square, kept, gap), expected, atol=1e-15)
    # What is inside when a motion begins is not counted, and a point that is inside blocks at once.
    sunk = corners_at([-0.01, 0.02, 0.02, 0.02])
    deepest = points.Contacts(*(part[:1] for part in sunk))
    allowed = points.penetration_allowed(sunk, deepest, 0.1)
    twists, centre = points.random_twists(sunk)
    blocked = points.wrenches(deepest, centre) @ twists.T < 0
    assert np.abs(allowed[blocked[0]]).max() == 0 and allowed.max() > 0.01
