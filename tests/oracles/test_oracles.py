"""The oracles against each other, against hand-worked answers, and against an independent library."""

import itertools
import random

import numpy as np
import pytest
import trimesh
from helpers.samples import random_poses

from oracles import abtree, triangle
from oracles.peers import fcl_faces, judge

# --- triangles -------------------------------------------------------------------------------------------------------

FLAT = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]

# Second triangle, whether it meets FLAT, what the case is.
KNOWN = [
    ([(1, 1, -1), (1, 1, 1), (9, 9, 1)], True, "an edge pierces"),
    ([(3, 3, -1), (3, 3, 1), (9, 9, 1)], False, "an edge passes beside"),
    ([(1, 1, 0), (1, 2, 5), (2, 1, 5)], True, "a vertex touches the inside"),
    ([(2, 2, 0), (3, 3, 5), (3, 3, 6)], True, "a vertex touches an edge"),
    ([(4, 0, 0), (9, 0, 5), (9, 1, 5)], True, "a shared vertex"),
    ([(0, 0, 0), (4, 0, 0), (2, -1, 5)], True, "a shared edge"),
    ([(2, -1, 0), (2, 1, 0), (2, 0, 5)], True, "an edge lies across"),
    ([(-1, -1, 0), (9, -1, 0), (0, -1, 5)], False, "an edge lies in the plane, outside"),
    ([(1, 1, 0), (2, 1, 0), (1, 2, 0)], True, "coplanar, inside"),
    ([(-9, -9, 0), (99, -9, 0), (-9, 99, 0)], True, "coplanar, around"),
    ([(4, 0, 0), (8, 0, 0), (8, 4, 0)], True, "coplanar, a vertex touches"),
    ([(5, 0, 0), (8, 0, 0), (8, 4, 0)], False, "coplanar, apart"),
    ([(3, 2, 0), (5, 5, 0), (2, 3, 0)], False, "coplanar, apart, boxes overlap"),
    ([(1, 1, 1), (2, 1, 1), (1, 2, 1)], False, "parallel"),
    ([(1, 1, 0), (1, 1, 0), (1, 1, 0)], True, "a point inside"),
    ([(2, 2, 0), (2, 2, 0), (2, 2, 0)], True, "a point on the edge"),
    ([(3, 3, 0), (3, 3, 0), (3, 3, 0)], False, "a point outside, in the plane"),
    ([(1, 1, 1), (1, 1, 1), (1, 1, 1)], False, "a point above"),
    ([(1, 1, -2), (1, 1, 1), (1, 1, 4)], True, "a segment pierces"),
    ([(1, 1, 1), (1, 1, 2), (1, 1, 4)], False, "a segment ends above"),
    ([(-1, 1, 0), (3, 1, 0), (9, 1, 0)], True, "a segment in the plane, across"),
    ([(-1, -1, 0), (3, -1, 0), (9, -1, 0)], False, "a segment in the plane, outside"),
]


def lattice_pairs(count, size, seed):
    """Corners on a tiny lattice: nearly all pairs share, touch, are coplanar or have zero area."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, size, (count, 2, 3, 3)).astype(float)


def flat_pairs(count, seed):
    """Two triangles in one oblique plane, with coordinates that stay exact."""
    rng = np.random.default_rng(seed)
    u, v, origin = (rng.integers(-(2**20), 2**20, (count, 1, 1, 3)).astype(float) for _ in range(3))
    s, t = (rng.integers(-3, 4, (count, 2, 3, 1)).astype(float) for _ in range(2))
    return (u * s + v * t + origin) * 2.0**-21


def near_pairs(count, seed):
    """Triangles that touch in a float, as near as floats come: the second is spanned by the first, then nudged."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(count, 3, 3))
    weight = rng.choice([0, 0, 0.25, 0.5, 1, -0.5], (count, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    b = (weight[:, :, :, None] * a[:, None]).sum(2)
    b += rng.choice([0, 0, 0, 1], (count, 3, 1)) * rng.normal(size=(count, 3, 3))
    b = np.where(rng.random(b.shape) < 0.5, b, np.nextafter(b, rng.choice([-9.0, 9.0], b.shape)))
    return np.stack([a, b], 1)


def wide_pairs(count, seed):
    """Coordinates over many binades, zeros among them."""
    rng = np.random.default_rng(seed)
    pairs = np.ldexp(rng.uniform(-1, 1, (count, 2, 3, 3)), rng.integers(-180, 3, (count, 2, 3, 3)))
    return np.where(rng.random(pairs.shape) < 0.3, 0.0, pairs)


def adversarial_pairs():
    lattices = lattice_pairs(900, 3, 1), lattice_pairs(300, 2, 2)
    generic = np.random.default_rng(6).normal(size=(500, 2, 3, 3))
    return np.concatenate([*lattices, flat_pairs(500, 3), near_pairs(900, 4), wide_pairs(400, 5), generic])


def orders(a, b):
    """All vertex orders of both triangles, either one first."""
    for p, q in itertools.product(itertools.permutations(a), itertools.permutations(b)):
        yield p, q
        yield q, p


LINE, POINT = [(0, 0, 0), (2, 2, 2), (1, 1, 1)], [(1, 2, 3)] * 3
# Segments and points: both triangles, and whether they meet.
DEGENERATE = [
    (LINE, [(3, 3, 3), (1, 1, 1), (9, 9, 9)], True),
    (LINE, [(3, 3, 3), (4, 4, 4), (9, 9, 9)], False),
    (LINE, [(1, 0, 0), (2, 1, 1), (3, 2, 2)], False),
    (LINE, [(2, 0, 1), (0, 2, 1), (0, 2, 1)], True),
    (LINE, [(2, 0, 1), (0, 2, 2), (0, 2, 2)], False),
    (POINT, POINT, True),
    (POINT, [(1, 2, 4)] * 3, False),
    (POINT, [(0, 1, 2), (1, 2, 3), (2, 3, 4)], True),
    ([(3, 4, 5)] * 3, [(0, 1, 2), (1, 2, 3), (2, 3, 4)], False),
]


@pytest.mark.parametrize("one, other, meets", [*((FLAT, other, meets) for other, meets, _ in KNOWN), *DEGENERATE])
def test_known_answers_in_every_vertex_order(one, other, meets):
    for a, b in orders(one, other):
        assert triangle.triangles_intersect(a, b) is meets
        assert triangle.triangles_intersect_fractions(a, b) is meets


@pytest.mark.slow
def test_integers_agree_with_fractions():
    pairs = adversarial_pairs()
    answers = [triangle.triangles_intersect(a, b) for a, b in pairs]
    assert answers == [triangle.triangles_intersect_fractions(a, b) for a, b in pairs]
    assert 0.3 < np.mean(answers) < 0.8  # both answers are well represented


def test_answer_is_independent_of_vertex_order():
    for pair in adversarial_pairs()[::60]:
        assert len({triangle.triangles_intersect(a, b) for a, b in orders(*pair)}) == 1


def test_filter_rejects_only_what_is_apart():
    pairs = np.concatenate([adversarial_pairs(), near_pairs(6000, 7), flat_pairs(2000, 8)])
    rejected = triangle.provably_apart(pairs[:, 0], pairs[:, 1])
    assert rejected.any()
    assert not any(triangle.triangles_intersect(a, b) for a, b in pairs[rejected])


def test_brute_force_equals_the_exact_test_of_every_pair():
    ball, ring = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.torus(0.9, 0.4, 8, 6)
    pose_a, pose_b = random_poses(np.random.default_rng(11), 2, 0.3)
    hits = triangle.brute_force_faces(ball.vertices, ball.faces, ring.vertices, ring.faces, pose_a, pose_b)
    points = triangle.into_frame_of_a(ring.vertices, pose_a, pose_b)
    every = list(itertools.product(range(len(ball.faces)), range(len(ring.faces))))
    meets = triangle.pairs_intersect(ball.vertices, ball.faces, points, ring.faces, every)
    assert hits.tolist() == np.array(every)[meets].tolist()
    assert len(hits) > 20


def test_relative_pose_is_the_rigid_motion():
    pose_a, pose_b = random_poses(np.random.default_rng(12), 2, 3.0)
    points = np.random.default_rng(13).normal(size=(50, 3))
    (ra, ta), (rb, tb) = triangle.pose_matrix(pose_a), triangle.pose_matrix(pose_b)
    assert np.allclose(ra @ ra.T, np.eye(3)) and np.isclose(np.linalg.det(ra), 1)
    assert np.allclose(triangle.quaternion_matrix((0, 0, 3, 3)) @ [1, 0, 0], [0, 1, 0])
    expected = (points @ rb.T + tb - ta) @ ra
    assert np.allclose(triangle.into_frame_of_a(points, pose_a, pose_b), expected, rtol=0, atol=1e-13)
    tiny = triangle.transform(np.eye(3), np.zeros(3), [[2.0**-291, 2.0**-290, -(2.0**-300)]])
    assert tiny.tolist() == [[0.0, 2.0**-290, 0.0]]


# --- the tree --------------------------------------------------------------------------------------------------------


def ball_mesh(seed=0):
    ball = trimesh.creation.icosphere(subdivisions=2)
    return abtree.random_progressive(ball.vertices, ball.faces, seed)


def soup_mesh(faces, seed=0):
    """Random corners: nonmanifold, with faces that repeat a corner and are never active."""
    rng = np.random.default_rng(seed)
    return abtree.random_progressive(
        rng.normal(size=(faces // 2 + 3, 3)), rng.integers(0, faces // 2 + 3, (faces, 3)), seed, 1
    )


MESHES = {"ball": ball_mesh, **{f"soup{n}": (lambda n=n: soup_mesh(n, n)) for n in (1, 2, 3, 5, 37, 100)}}


@pytest.fixture(params=MESHES)
def mesh(request):
    return MESHES[request.param]()


def snapshot(tree):
    """The state as bytes: unlike ==, it tells -0.0 from 0.0."""
    return {name: array.tobytes() for name, array in tree.flat().items()}


def test_progressive_record_is_consistent(mesh):
    for lod in range(mesh.lod_max + 1):
        for face in range(len(mesh.face_vertex)):
            assert mesh.is_active(face, lod) == (len(set(mesh.corners(face, lod))) == 3)
    for lod in range(mesh.lod_max):
        changed = [f for f in range(len(mesh.face_vertex)) if mesh.corners(f, lod) != mesh.corners(f, lod + 1)]
        listed = mesh.split_face[mesh.split_start[lod] : mesh.split_start[lod + 1]]
        assert sorted(listed) == [f for f in changed if mesh.is_active(f, lod + 1)]


def test_tree_follows_a_random_walk_of_lods(mesh):
    rng = random.Random(5)
    tree, fresh, n = abtree.active_build(mesh), abtree.active_build(mesh), len(mesh.face_vertex)
    for _ in range(40):
        step = rng.choice([1, 1, 3, mesh.lod_max])
        lod = min(max(tree.lod + rng.randint(-step, step), 0), mesh.lod_max)
        update = abtree.set_lod(tree, lod)
        abtree.rebuild(fresh, lod)
        assert snapshot(tree) == snapshot(fresh)
        assert update.nodes_refitted <= abtree.refit_bound(n, update.k)


def test_state_is_what_the_definitions_say(mesh):
    for lod in {0, mesh.lod_max // 2, mesh.lod_max}:
        tree = abtree.active_build(mesh, lod)
        below = {}
        for node in reversed(list(tree.nodes())):
            below[node] = [node.index] if node.is_leaf else below[node.left] + below[node.right]
            alive = [f for f in below[node] if mesh.is_active(f, lod)]
            assert node.status == (abtree.ACTIVE if alive else abtree.INACTIVE)
            if not alive:
                assert node.range == abtree.EMPTY and node.skip is None
                continue
            points = np.array([mesh.vertex_pos[v] for f in alive for v in mesh.corners(f, lod)]) - mesh.centre()
            lower, upper = np.float32(node.range[0]), np.float32(node.range[1])
            assert (lower < points.min(0)).all() and (np.nextafter(lower, np.float32(9)) >= points.min(0)).all()
            assert (upper > points.max(0)).all() and (np.nextafter(upper, np.float32(-9)) <= points.max(0)).all()
            assert [f for f in below[node.skip] if mesh.is_active(f, lod)] == alive
            opened = [node.skip.left, node.skip.right] if not node.skip.is_leaf else []
            assert all(child.status == abtree.ACTIVE for child in opened)


def test_tree_shape(mesh):
    tree, n = abtree.active_build(mesh), len(mesh.face_vertex)
    nodes = {node.number: node for node in tree.nodes()}
    assert len(nodes) == 2 * n - 1 and max(nodes).bit_length() - 1 == (n - 1).bit_length()
    assert [leaf.index for leaf in tree.leaf] == list(range(n))
    for number, node in nodes.items():
        depth = number.bit_length() - 1
        i = number - (1 << depth)
        count = ((i + 1) * n >> depth) - (i * n >> depth)
        assert node.is_leaf == (count == 1)
        assert node.is_leaf or (node.left.number, node.right.number) == (2 * number, 2 * number + 1)
        assert node.parent is nodes.get(number // 2)


def test_split_is_the_median_on_the_longest_axis():
    """Four faces along y, the two middle ones with equal keys: the lower index goes left."""
    position = [p for y in (9, 4, 4, 0) for p in ((0, y, 0), (1, y, 0), (0, y + 1, 0))]
    mesh = abtree.Progressive([-1] * 12, position, np.arange(12).reshape(4, 3).tolist(), [0] * 4, [0], [])
    assert [leaf.number for leaf in abtree.active_build(mesh).leaf] == [7, 5, 6, 4]


# --- peers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_fcl_agrees_but_for_what_it_gets_wrong(seed):
    pytest.importorskip("fcl")
    ball, ring = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.torus(0.9, 0.3, 32, 24)
    pair = (
        ball.vertices,
        ball.faces,
        ring.vertices,
        ring.faces,
        *random_poses(np.random.default_rng(20 + seed), 2, 0.3),
    )
    ours, peer = triangle.brute_force_faces(*pair), fcl_faces(*pair)
    verdict = judge(ours, peer, *pair)
    assert verdict.ours_wrong == []
    assert len(verdict.peer_wrong) <= 0.01 * len(ours)
    assert len(ours) > 100


def test_judge_names_the_culprit():
    ball = trimesh.creation.icosphere(subdivisions=1)
    pair = (ball.vertices, ball.faces, ball.vertices, ball.faces, *random_poses(np.random.default_rng(30), 2, 0.2))
    truth = [tuple(hit) for hit in triangle.brute_force_faces(*pair).tolist()]
    miss = next((f, g) for f in range(80) for g in range(80) if (f, g) not in truth)
    verdict = judge([miss, *truth[2:]], truth[1:], *pair)
    assert (verdict.ours_invented, verdict.ours_missed, verdict.peer_missed) == ([miss], [truth[1]], [])
    verdict = judge(truth, [miss, *truth[1:]], *pair)
    assert (verdict.peer_invented, verdict.peer_missed, verdict.ours_wrong) == ([miss], [truth[0]], [])
