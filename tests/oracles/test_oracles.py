"""The oracles against each other, and against hand-worked answers."""

import itertools
import random

import numpy as np
import pytest
import trimesh
from helpers.samples import plain, random_poses, sample

from oracles import abtree, triangle

FLAT, LINE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)], [(0, 0, 0), (2, 2, 2), (1, 1, 1)]

# Two triangles, and whether they meet.
KNOWN = {
    "an edge pierces": (FLAT, [(1, 1, -1), (1, 1, 1), (9, 9, 1)], True),
    "an edge passes beside": (FLAT, [(3, 3, -1), (3, 3, 1), (9, 9, 1)], False),
    "a shared edge": (FLAT, [(0, 0, 0), (4, 0, 0), (2, -1, 5)], True),
    "coplanar, inside": (FLAT, [(1, 1, 0), (2, 1, 0), (1, 2, 0)], True),
    "coplanar, a vertex touches": (FLAT, [(4, 0, 0), (8, 0, 0), (8, 4, 0)], True),
    "coplanar, apart, boxes overlap": (FLAT, [(3, 2, 0), (5, 5, 0), (2, 3, 0)], False),
    "a point on the edge": (FLAT, [(2, 2, 0)] * 3, True),
    "a segment pierces": (FLAT, [(1, 1, -2), (1, 1, 1), (1, 1, 4)], True),
    "a segment in the plane, across": (FLAT, [(-1, 1, 0), (3, 1, 0), (9, 1, 0)], True),
    "segments overlap": (LINE, [(3, 3, 3), (1, 1, 1), (9, 9, 9)], True),
    "segments cross": (LINE, [(2, 0, 1), (0, 2, 1), (0, 2, 1)], True),
    "segments pass": (LINE, [(2, 0, 1), (0, 2, 2), (0, 2, 2)], False),
    "a point on a segment": ([(1, 2, 3)] * 3, [(0, 1, 2), (1, 2, 3), (2, 3, 4)], True),
    "a point beside a segment": ([(3, 4, 5)] * 3, [(0, 1, 2), (1, 2, 3), (2, 3, 4)], False),
}


@pytest.mark.parametrize("case", KNOWN)
def test_known_answers_in_every_vertex_order(case):
    one, other, meets = KNOWN[case]
    for p, q in itertools.product(itertools.permutations(one), itertools.permutations(other)):
        for a, b in ((p, q), (q, p)):
            assert triangle.triangles_intersect(a, b) is meets


def test_either_triangle_clips_the_other_and_the_filter_rejects_only_what_is_apart():
    """Pairs on a tiny lattice, which share, touch and are flat; and pairs that touch, or nearly so, in a float."""
    rng = np.random.default_rng(1)
    a = rng.normal(size=(2000, 3, 3))
    weight = rng.choice([0, 0, 0.25, 0.5, 1, -0.5], (2000, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    b = (weight[:, :, :, None] * a[:, None]).sum(2)
    b += rng.choice([0, 0, 0, 1], (2000, 3, 1)) * rng.normal(size=(2000, 3, 3))
    b = np.where(rng.random(b.shape) < 0.5, b, np.nextafter(b, rng.choice([-9.0, 9.0], b.shape)))
    pairs = np.concatenate([rng.integers(0, 3, (1000, 2, 3, 3)).astype(float), np.stack([a, b], 1)])
    answers = np.array([triangle.triangles_intersect(a, b) for a, b in pairs])
    assert answers.tolist() == [triangle.triangles_intersect(b, a) for a, b in pairs]
    rejected = triangle.provably_apart(pairs[:, 0], pairs[:, 1])
    assert rejected.any() and not answers[rejected].any() and 0.3 < answers.mean() < 0.8


def test_brute_force_equals_the_exact_test_of_every_pair():
    ball, ring = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.torus(0.9, 0.4, 8, 6)
    pose_a, pose_b = random_poses(np.random.default_rng(11), 2, 0.3)
    hits = triangle.brute_force_faces(ball.vertices, ball.faces, ring.vertices, ring.faces, pose_a, pose_b)
    points = triangle.into_frame_of_a(ring.vertices, pose_a, pose_b)
    every = list(itertools.product(range(len(ball.faces)), range(len(ring.faces))))
    meets = triangle.pairs_intersect(ball.vertices, ball.faces, points, ring.faces, every)
    assert hits.tolist() == np.array(every)[meets].tolist()
    assert len(hits) > 20


@pytest.mark.parametrize("name", ["one", "three", "soup"])
def test_tree_follows_a_random_walk_of_lods(name):
    """Updated trees hold the bits of rebuilt ones, and what the definitions say."""
    mesh, rng = plain(sample(name, base_faces=1)), random.Random(5)
    tree, fresh = abtree.active_build(mesh), abtree.active_build(mesh)
    for _ in range(40):
        step = rng.choice([1, 1, 3, mesh.lod_max])
        update = abtree.set_lod(tree, min(max(tree.lod + rng.randint(-step, step), 0), mesh.lod_max))
        abtree.rebuild(fresh, tree.lod)
        states = tree.flat(), fresh.flat()
        assert all(states[0][key].tobytes() == states[1][key].tobytes() for key in states[0])
        assert update.nodes_refitted <= abtree.refit_bound(len(mesh.face_vertex), update.k)
    below = {}
    for node in reversed(list(tree.nodes())):
        below[node] = [node.index] if node.is_leaf else below[node.left] + below[node.right]
        alive = [f for f in below[node] if mesh.is_active(f, tree.lod)]
        assert node.status == (abtree.ACTIVE if alive else abtree.INACTIVE)
        if not alive:
            assert node.range == abtree.EMPTY and node.skip is None
            continue
        points = np.array([mesh.vertex_pos[v] for f in alive for v in mesh.corners(f, tree.lod)]) - mesh.centre()
        lower, upper = np.float32(node.range[0]), np.float32(node.range[1])
        assert (lower < points.min(0)).all() and (np.nextafter(lower, np.float32(9)) >= points.min(0)).all()
        assert (upper > points.max(0)).all() and (np.nextafter(upper, np.float32(-9)) <= points.max(0)).all()
        assert [f for f in below[node.skip] if mesh.is_active(f, tree.lod)] == alive
        opened = [node.skip.left, node.skip.right] if not node.skip.is_leaf else []
        assert all(child.status == abtree.ACTIVE for child in opened)


def strips(ys, length):
    """Faces one unit wide along y, so long along x."""
    position = [p for y in ys for p in ((0, y, 0), (length, y, 0), (0, y + 1, 0))]
    faces = np.arange(3 * len(ys)).reshape(-1, 3).tolist()
    return abtree.Progressive([-1] * len(position), position, faces, [0] * len(ys), [0], [])


@pytest.mark.parametrize(("count", "first"), [(9, {0, 1, 2, 3}), (10, {1, 3, 5, 7, 9})])
def test_many_faces_split_where_the_halves_are_smallest(count, first):
    """Long strips, by index from both ends of y: split along x, their longest axis, both halves have all of y.

    Few go by the longest axis: of four along y, the two middle ones with equal keys, the lower index goes left.
    """
    tree = abtree.active_build(strips([-i if i % 2 else i for i in range(count)], 20))
    assert {i for i, leaf in enumerate(tree.leaf) if bin(leaf.number)[3] == "0"} == first
    assert [leaf.number for leaf in abtree.active_build(strips((9, 4, 4, 0), 1)).leaf] == [7, 5, 6, 4]
