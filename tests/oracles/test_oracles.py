"""The oracles against each other, and against hand-worked answers."""

import itertools
import random

import numpy as np
import pytest
import trimesh
from helpers.samples import plain, random_poses, sample

from oracles import abtree, triangle

# --- triangles -------------------------------------------------------------------------------------------------------

FLAT, LINE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)], [(0, 0, 0), (2, 2, 2), (1, 1, 1)]

# Two triangles, and whether they meet.
KNOWN = {
    "an edge pierces": (FLAT, [(1, 1, -1), (1, 1, 1), (9, 9, 1)], True),
    "an edge passes beside": (FLAT, [(3, 3, -1), (3, 3, 1), (9, 9, 1)], False),
    "a vertex touches an edge": (FLAT, [(2, 2, 0), (3, 3, 5), (3, 3, 6)], True),
    "a shared edge": (FLAT, [(0, 0, 0), (4, 0, 0), (2, -1, 5)], True),
    "an edge lies in the plane, outside": (FLAT, [(-1, -1, 0), (9, -1, 0), (0, -1, 5)], False),
    "coplanar, inside": (FLAT, [(1, 1, 0), (2, 1, 0), (1, 2, 0)], True),
    "coplanar, a vertex touches": (FLAT, [(4, 0, 0), (8, 0, 0), (8, 4, 0)], True),
    "coplanar, apart, boxes overlap": (FLAT, [(3, 2, 0), (5, 5, 0), (2, 3, 0)], False),
    "a point on the edge": (FLAT, [(2, 2, 0)] * 3, True),
    "a point outside, in the plane": (FLAT, [(3, 3, 0)] * 3, False),
    "a segment pierces": (FLAT, [(1, 1, -2), (1, 1, 1), (1, 1, 4)], True),
    "a segment ends above": (FLAT, [(1, 1, 1), (1, 1, 2), (1, 1, 4)], False),
    "a segment in the plane, across": (FLAT, [(-1, 1, 0), (3, 1, 0), (9, 1, 0)], True),
    "segments overlap": (LINE, [(3, 3, 3), (1, 1, 1), (9, 9, 9)], True),
    "parallel segments": (LINE, [(1, 0, 0), (2, 1, 1), (3, 2, 2)], False),
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
            assert triangle.triangles_intersect(a, b) is bool(triangle.shared_polygon(a, b)) is meets


def flat_pairs(rng, count):
    """Two triangles in one oblique plane, with coordinates that stay exact."""
    u, v, origin = (rng.integers(-(2**20), 2**20, (count, 1, 1, 3)).astype(float) for _ in range(3))
    s, t = (rng.integers(-3, 4, (count, 2, 3, 1)).astype(float) for _ in range(2))
    return (u * s + v * t + origin) * 2.0**-21


def near_pairs(rng, count):
    """Triangles that touch in a float, as near as floats come: the second is spanned by the first, then nudged."""
    a = rng.normal(size=(count, 3, 3))
    weight = rng.choice([0, 0, 0.25, 0.5, 1, -0.5], (count, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    b = (weight[:, :, :, None] * a[:, None]).sum(2)
    b += rng.choice([0, 0, 0, 1], (count, 3, 1)) * rng.normal(size=(count, 3, 3))
    b = np.where(rng.random(b.shape) < 0.5, b, np.nextafter(b, rng.choice([-9.0, 9.0], b.shape)))
    return np.stack([a, b], 1)


def adversarial_pairs():
    """Pairs on a tiny lattice, which share, touch and are flat; coplanar, near, of many binades, and random ones."""
    rng = np.random.default_rng(1)
    lattice = rng.integers(0, 3, (900, 2, 3, 3)).astype(float)
    wide = np.ldexp(rng.uniform(-1, 1, (400, 2, 3, 3)), rng.integers(-180, 3, (400, 2, 3, 3)))
    wide = np.where(rng.random(wide.shape) < 0.3, 0.0, wide)
    return np.concatenate([lattice, flat_pairs(rng, 700), near_pairs(rng, 900), wide, rng.normal(size=(500, 2, 3, 3))])


@pytest.mark.slow
def test_integers_agree_with_fractions():
    pairs = adversarial_pairs()
    answers = [triangle.triangles_intersect(a, b) for a, b in pairs]
    assert answers == [bool(triangle.shared_polygon(a, b)) for a, b in pairs]
    assert 0.3 < np.mean(answers) < 0.8  # both answers are well represented


def test_filter_rejects_only_what_is_apart():
    pairs = np.concatenate([adversarial_pairs(), near_pairs(np.random.default_rng(7), 6000)])
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


# --- the tree --------------------------------------------------------------------------------------------------------


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


def test_split_is_the_median_on_the_longest_axis():
    """Four faces along y, the two middle ones with equal keys: the lower index goes left."""
    position = [p for y in (9, 4, 4, 0) for p in ((0, y, 0), (1, y, 0), (0, y + 1, 0))]
    mesh = abtree.Progressive([-1] * 12, position, np.arange(12).reshape(4, 3).tolist(), [0] * 4, [0], [])
    assert [leaf.number for leaf in abtree.active_build(mesh).leaf] == [7, 5, 6, 4]
