"""No bound is too large: faces that are nearer by a part in 10^8 than very many others are found, slabs or not.

Mean slabs of nodes and balls about their boxes' centres hold the faces below, and are no larger than need be.
"""

import numpy as np
import pytest
from conftest import slow
from helpers.questions import pairs_of, scene_of, to_bytes, to_matrix
from helpers.samples import STILL, grid, mirrored, random_quaternions, sample
from oracles.distance import mesh_distance
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels import native
from warp_abtree.kernels.base.poses import ROUNDING_32
from warp_abtree.kernels.distance.frame import PAIRS_LEAST
from warp_abtree.kernels.distance.slab_bound import BOUND_MARGINS
from warp_abtree.kernels.search.mean_slabs import USES_MIN

# Rows: corners of A and of B, B's quaternion, and how far the first corners are apart: slabs' roundings add up to 5.4
# times u (r_a + r_b + s) for warps, to 4.2 times that on a CPU, of 45 that margins have.
ROUNDED = """
-0.0063452670170715 0.006495436896775595 -0.003366734468144777
-0.011223352340720298 0.0028906581802885353 -0.0031412251042453746
-0.010965733792827123 0.0015656533173187379 -0.002161921759568002
-0.8418633340994 0.4955881816668027 1.9747835396765856
-0.15469808320047174 0.246982734107978 -0.49405666572617807
0.8368920059023238 -0.938772821034292 -1.0660586309026445
0.7220642233492901 -0.3959232800579053 -0.987666057400544 0.7721717006863813
4.903547460711388e-07 -3.048028864489987e-08 -4.645371978133124e-07

-0.07835333056226623 -0.04156394784183524 0.016411565058202154
-0.10877598235906367 -0.04500907586634343 -0.007771817244874567
-0.08999167518814356 -0.07509105506312413 -0.0025541332151526744
0.4100274887918493 0.2983457445508492 -0.3335259854563965
0.14144962243683004 0.10887864875509415 0.008037718427744273
0.03330987125751328 -0.23660277730000032 -0.018759052129049186
0.31006069285811616 -1.4721559474149521 -1.1559079557234815 -0.7234266875990177
3.7854399816146004e-08 4.116893343448102e-09 -2.540862579941426e-09
"""


def sheets(rng, roughness, far, bend, side=9):
    """Return two sheets over one another, their corners up or down by a little, in frames of their own, and poses."""
    vertices, faces = grid(side)
    vertices = vertices / side - [0.5, 0.5, 0.0]
    below, above = vertices + roughness * rng.normal(size=(2, *vertices.shape)) * [0, 0, 1]
    below, above = (v - [0, 0, side * bend] * (v[:, :2] ** 2).sum(1)[:, None] for v, side in ((below, 1), (above, -1)))
    above[:, 2] += 0.25
    models, poses = [], []
    for points in (below, above):
        turn, shift = random_quaternions(rng, 1)[0], far * rng.normal(size=3)
        models.append(ab.Model.from_arrays(points @ quaternion_matrix(turn) + shift, faces, base_faces=200))
        position = -quaternion_matrix(turn) @ shift
        poses.append(np.concatenate([position, turn]))
    return models, poses


@pytest.mark.parametrize("roughness", [*slow(1e-6), 1e-8, 1e-10])
@pytest.mark.parametrize("far", [0.0, 100.0])
@pytest.mark.parametrize("bend", [0.0, 0.3])
def test_nearly_equally_near_faces(device, roughness, far, bend):
    rng = np.random.default_rng(1)
    check_sheets(device, [sheets(rng, roughness, far, bend) for _ in range(2)], 1 + far)


def check_sheets(device, sheets, size):
    """Compare with brute force, without slabs, with slabs from the start, and from the answer; threads and warps."""
    cases = [(a, a.lod_max, pose_a, b, b.lod_max, pose_b) for (a, b), (pose_a, pose_b) in sheets]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    # So many that warps, too, make slabs of them.
    pairs = np.tile(pairs, (-(-int(PAIRS_LEAST) // len(pairs)), 1))
    truths = [mesh_distance(*case) for case in cases]
    for warps in (None, True):
        with testing.regime(warps=warps):
            check_queries(ab.DistanceQuery(scene, pairs), truths, size)


def check_queries(query, truths, size):
    first = query.run()
    assert first.distance[: len(truths)] == pytest.approx(truths, rel=1e-13, abs=1e-15 * size)
    slabs, with_slabs = query.stages[-1].slabs.made, 0
    for _ in range(20):
        query.launch()
        assert to_bytes(query.result()) == to_bytes(first)
        if (slabs.numpy()[:, 0] >= 0).sum() == len(query.batch.states.slots):
            query.forget()
            with_slabs += 1
            if with_slabs == 3:
                return
    raise AssertionError("there are no slabs of all states")


@pytest.mark.parametrize("far", [0.0, 100.0])
@pytest.mark.parametrize("roughness", [*slow(1e-7), 1e-9])
def test_very_many_nearly_equally_near_faces(device, roughness, far):
    """So many that slabs are compared along the nodes' own normals, on the CPU; warps have none for so few pairs."""
    rng = np.random.default_rng(4)
    cases = []
    for bend in (0.0, 0.1, 0.02):
        (a, b), (pose_a, pose_b) = sheets(rng, roughness, far, bend, side=32)
        cases.append((a, None, pose_a, b, None, pose_b))
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    with testing.regime(warps=True):
        expected = ab.DistanceQuery(scene, pairs).run()
    query = ab.DistanceQuery(scene, pairs)
    for _ in range(17):
        query.launch()
    query.forget()
    found = query.run()
    assert to_bytes(found) == to_bytes(expected)
    assert (found.triangle_tests > 6000).any()


@pytest.mark.parametrize("case", [0, 1], ids=["warps", "threads"])
def test_margins_of_slabs_cover_roundings_that_add_up(device, regime, case):
    """Beside its mirror image in the origin each face is one of two, so that slabs of nodes are compared."""
    rows = ROUNDED.strip().split("\n\n")[case].split("\n")
    *corners, quaternion, apart = (np.array(row.split(), float) for row in rows)
    faces = np.reshape(corners, (2, 3, 3))
    rotation = quaternion_matrix(quaternion)
    pose = to_matrix(rotation, faces[0][0] - rotation @ faces[1][0] + apart)
    a, b = map(mirrored, faces)
    scene = scene_of(device, [(a, None, STILL, b, None, pose)])
    pairs = [(0, 1)] * int(PAIRS_LEAST)
    distance = mesh_distance(a, a.lod_max, STILL, b, b.lod_max, pose)
    query = ab.DistanceQuery(scene, pairs, beyond=distance * (1 + 1e-9))
    query.run()
    query.forget()
    found = query.run()
    assert (query.stages[-1].slabs.made.numpy()[:, 0] >= 0).sum() == 2
    np.testing.assert_allclose(found.distance, distance, rtol=1e-6)


def beside_one_another(rng, length=3000.0, reach=1e-2):
    """Return A, B and the pose of B: each a face at either end of a rod, the ends that are nearest 1 apart across it.

    The four ends' middles join along the rod, so that the nearest are apart across that direction, and their balls are
    as large as the faces, whose corners lead away from one another.
    """
    rod = rng.normal(size=3)
    rod /= np.linalg.norm(rod)
    way = np.cross(rod, rng.normal(size=3))
    way /= np.linalg.norm(way)
    turn = quaternion_matrix(random_quaternions(rng, 1)[0])
    aside = reach * np.array([[0, 0], [-1, 1e-4], [-1, -1e-4]]) @ [way, rod]
    ends = 0.5 * length * rod + aside, (-0.5 * length * rod - aside) @ turn
    a, b = map(mirrored, ends)
    return a, a.lod_max, STILL, b, b.lod_max, to_matrix(turn, length * rod + way)


def test_margins_of_balls_cover_roundings(device, regime):
    """Nodes that are apart across the direction in which slabs are compared; without the margin some are lost."""
    rng = np.random.default_rng(0)
    cases = [beside_one_another(rng) for _ in range(40)]
    truths = np.tile([mesh_distance(*case) for case in cases], int(USES_MIN) + 1)
    pairs = np.tile(pairs_of(cases), (int(USES_MIN) + 1, 1))
    query = ab.DistanceQuery(scene_of(device, cases), pairs, beyond=truths * (1 + 1e-9))
    for _ in range(2):
        query.run()
        query.forget()
    assert (query.stages[-1].slabs.made.numpy()[:, 0] >= 0).sum() == 2 * len(cases)
    np.testing.assert_allclose(query.run().distance, truths, rtol=1e-6)


def test_slabs_leave_off_what_roundings_add_up_to():
    """Those of docs/exactness.md, in u of the reaches of A and of B and of the translation, along n and across it."""
    along, across = (17.6, 26.9, 8.3), (25, 37, 27)
    room = float(BOUND_MARGINS) / 2 * float(ROUNDING_32) / 2.0**-24
    assert room >= max(*along, *across) and int(BOUND_MARGINS) == native.constant("SLAB_MARGINS")
    assert "boxes.margin = SLAB_MARGINS * scaling.margin;" in native.read("distance/search.h")
    assert native.read("distance/slab_bounds.h").count(" - margin)") == 3  # along n, across it, along a node's own


def read_slabs(device, model, lod):
    """Return a state of a model, and the records of its nodes: normal, ends, weight and radius, float32 (nodes, 7)."""
    scene = scene_of(device, [(model, lod, STILL, sample("box"), None, STILL)])
    query = ab.DistanceQuery(scene, [(0, 1)] * max(int(PAIRS_LEAST), int(USES_MIN)))
    for _ in range(2):
        query.launch()
    slabs = query.stages[-1].slabs
    assert slabs.made.numpy()[0, 0] == lod
    state = scene.tree_state(0)
    records = slabs.record.numpy().reshape(-1, 8)[: len(state.status), :7]  # of inactive nodes no numbers
    return state, records


@pytest.mark.parametrize("name", ["torus", "soup", "crumbs", "lattice soup"])
@pytest.mark.parametrize("part", [1.0, 0.6, 0.1])
def test_slabs_and_balls_hold_their_faces(device, regime, name, part):
    """Of every active node; a leaf's ball reaches its farthest corner, another's no farther than its box does."""
    model = sample(name)
    lod = round(part * model.lod_max)
    state, records = read_slabs(device, model, lod)
    vertices, faces, ids = model.mesh_at(lod)
    near = vertices - model.centre
    rounding = 2.0**-22 * np.abs(near).max()  # of vertices to float32, and of ends
    leaves, corners, checked = state.face_node[ids], near[faces], [0, 0]
    for node in np.flatnonzero(state.status):
        below = corners[leaves >> np.maximum(depth_of(leaves) - depth_of(node), 0) == node]
        assert len(below)
        normal, (low, high, _, radius) = np.split(records[node].astype(float), [3])
        along, middle = below @ normal, (state.lower[node] + state.upper[node]) / 2 - model.centre
        reach = np.linalg.norm(below - middle, axis=2).max()
        assert abs(np.linalg.norm(normal) - 1) < 1e-6 or not normal.any()
        assert low <= along.min() + rounding and along.max() - rounding <= high
        assert reach - rounding <= radius <= np.linalg.norm(state.upper[node] - state.lower[node]) / 2 + rounding
        if len(below) == 1:
            assert radius <= reach + rounding and high - low <= np.ptp(along) + 2 * rounding
        half = np.linalg.norm(state.upper[node] - state.lower[node]) / 2
        checked[int(len(below) > 1 and radius < 0.98 * half)] += 1
    assert sum(checked) > 8 and (checked[1] > 0 or name != "soup")


def depth_of(node):
    """Return the level of heap indices, the root's 0."""
    return np.frexp(np.asarray(node, float))[1] - 1
