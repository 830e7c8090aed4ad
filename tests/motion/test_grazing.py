"""Linear CCD: corners that graze against fractions, whole meshes, and public queries with ground truth."""

import itertools

import numpy as np
import pytest
import trimesh
from helpers.motions import find, random_motions
from helpers.scenes import scene_with
from oracles.motion import straight_soups
from oracles.straight import Motion
from oracles.triangle import box_pairs, pairs_intersect, triangles_intersect

import warp_abtree as ab
from bench.motions.ccd_queries import CORNERS, FOLDER, read_queries
from warp_abtree import testing

KINDS = ("vertex-face", "edge-edge")
FACE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
ACROSS, LINE = [(0, 0, 0), (4, 0, 0), (2, -2, 0), (2, 2, 0)], [(0, 0, 0), (1, 0, 0), (3, 0, 0), (4, 0, 0)]


def moved(points, *ways):
    """Return points and where they end, which go by ways; the last way for the rest."""
    ways = [*ways, *[ways[-1]] * (len(points) - len(ways))]
    return points, [tuple(np.add(p, w)) for p, w in zip(points, ways)]


VERTEX, EDGES = KINDS
ROD = [(0, 0, 1), (2, 0, 1)]
# Features, their corners and ways, and whether they meet.
KNOWN = {
    "through a face": (VERTEX, moved([(1, 1, 1), *FACE], (0, 0, -2), (0, 0, 0)), True),
    "beside it": (VERTEX, moved([(3, 3, 1), *FACE], (0, 0, -2), (0, 0, 0)), False),
    "onto it at last": (VERTEX, moved([(1, 1, 1), *FACE], (0, 0, -1), (0, 0, 0)), True),
    "not quite": (VERTEX, moved([(1, 1, 1), *FACE], (0, 0, -0.99), (0, 0, 0)), False),
    "in its plane, past a corner": (VERTEX, moved([(-2, -1, 0), *FACE], (4, -2, 0), (0, 0, 0)), False),
    "in its plane, over a corner": (VERTEX, moved([(-1, 1, 0), *FACE], (2, -2, 0), (0, 0, 0)), True),
    "onto a face that becomes a line": (VERTEX, moved([(1, 1, 0), *FACE], *[(0, 0, 0)] * 3, (4, -4, 0)), True),
    "one edge over the other": (EDGES, moved([*ACROSS[:2], (2, -2, 1), (2, 2, 1)], (0, 0, 2), (0, 0, 0)), True),
    "along the other's line": (EDGES, moved(LINE, (1, 0, 0)), False),
    "onto its end": (EDGES, moved(LINE, (2, 0, 0), (2, 0, 0), (0, 0, 0)), True),
    "parallel, over": (EDGES, moved([*ROD, (1, 0, 0), (4, 0, 0)], *[(0, 0, -2)] * 2, (0, 0, 0)), True),
    "parallel, past the end": (EDGES, moved([*ROD, *LINE[2:]], *[(0, 0, -2)] * 2, (0, 0, 0)), False),
}


def truth(kind, starts, ends):
    return np.array([Motion(s, e, kind == "edge-edge").meet() for s, e in zip(starts.tolist(), ends.tolist())])


def answers(kind, starts, ends, device):
    """Return times, and which are clear and undecided, of points (p, 4, 3)."""
    corners = list(CORNERS[kind])
    return testing.advance_corners(starts[:, corners], ends[:, corners], 1e-6, device)


@pytest.mark.parametrize("name", KNOWN)
def test_known_answers(name, device):
    kind, (first, last), meets = KNOWN[name]
    starts, ends = np.array([first], float), np.array([last], float)
    assert truth(kind, starts, ends)[0] == meets
    assert answers(kind, starts, ends, device)[1][0] == (not meets)


def lattice(rng, count, flat):
    """Return starts and ends (count, 4, 3) of coordinates 0, 1 and 2, of some in one plane at all times."""
    starts, ends = rng.integers(0, 3, (2, count, 4, 3)).astype(float)
    for points in (starts, ends):
        points[:flat, :, 2] = 0
    return starts, ends


@pytest.mark.parametrize("kind", KINDS)
def test_lattice_seen_askew(kind, device):
    """Corners on corners, edges in line, faces without area: nothing is missed, and all else proved clear.

    A matrix of whole numbers of 40 bits changes no answer, but rounds what is computed.
    """
    rng = np.random.default_rng(1)
    starts, ends = lattice(rng, 250, 100)
    askew = rng.integers(-(2**40), 2**40, (3, 3)).astype(float)
    meets = truth(kind, starts, ends)
    assert 75 < meets.sum() < 175
    for m in (np.eye(3), askew):
        _, clear, undecided = answers(kind, starts @ m, ends @ m, device)
        assert clear.tolist() == (~meets).tolist() and not undecided.any()


@pytest.mark.parametrize("kind", KINDS)
def test_lattice_moved_by_very_little(kind, device):
    """Gaps down to 2^-90 and, where corners nearly meet edges in line, squares of that: nothing is missed."""
    rng, count = np.random.default_rng(2), 300
    starts, ends = lattice(rng, count, count // 15)
    power = np.where(np.arange(count) % 2 == 0, rng.integers(35, 41, count), rng.integers(41, 91, count))
    for points in (starts, ends):
        points += (points == 0) * rng.integers(-1, 2, points.shape) * 2.0 ** -power[:, None, None]
    meets = truth(kind, starts, ends)
    _, clear, _ = answers(kind, starts, ends, device)
    assert not clear[meets].any() and meets.sum() > count // 15
    assert (clear | meets)[power < 41].mean() > 0.99
    assert (~clear & ~meets).sum() < 0.1 * (~meets).sum()


def features_at_origin():
    """Yield two faces (6, 3) of which any corner and the other face, or any edges, meet at 0, A's below B's."""
    point, face = np.array([[0, 0, 0], [2, 0, -1], [1, 2, -1]]), np.array([[-1, -1, 0], [2, -1, 0], [-1, 2, 0]])
    along, over = np.array([[-1, 0, 0], [1, 0, 0], [0, 1, -1]]), np.array([[0, -1, 0], [0, 1, 0], [1, 0, 1]])
    for i in range(3):
        yield np.concatenate([np.roll(point, i, 0), face])
        yield np.concatenate([-face, np.roll(-point, i, 0)])
        for j in range(3):
            yield np.concatenate([np.roll(along, i, 0), np.roll(over, j, 0)])


@pytest.mark.parametrize("gap", [2.0**-60, 0.0, -(2.0**-60)])
def test_each_pair_of_features(gap, device):
    """B comes down on A, and stops before that, or not."""
    starts = np.array(list(features_at_origin()), float)
    ends = starts.copy()
    starts[:, 3:, 2] += 1
    ends[:, 3:, 2] += gap * (ends[:, 3:, 2] == 0)
    time, clear, undecided = testing.advance_corners(starts, ends, 1e-6, device)
    assert (clear == (gap > 0)).all() and not undecided.any() and len(starts) == 15
    assert (time >= 1 - 1e-6).all()


def faces_meet(first, last):
    """Return whether two faces (6, 3) meet: at first, or later where a corner meets a face or an edge an edge."""
    if triangles_intersect(*(tuple(map(tuple, corners)) for corners in (first[:3], first[3:]))):
        return True
    faces = (0, 1, 2), (3, 4, 5)
    chosen = [([k, *face], False) for face, other in (faces, faces[::-1]) for k in other]
    sides = [[(face[k], face[k - 1]) for k in range(3)] for face in faces]
    chosen += [([*p, *q], True) for p, q in itertools.product(*sides)]
    return any(Motion([first[k] for k in rows], [last[k] for k in rows], edges).meet() for rows, edges in chosen)


def test_faces_on_a_lattice(device):
    """Whole faces, of which a half hardly move: some pierce one another from first to last, and no corner meets."""
    rng = np.random.default_rng(3)
    starts, ends = rng.integers(0, 4, (2, 160, 6, 3)).astype(float)
    ends[:80] = starts[:80] + (rng.random((80, 6, 3)) < 0.1) * 2.0**-50
    meets = np.array([faces_meet(*case) for case in zip(starts.tolist(), ends.tolist())])
    _, clear, undecided = testing.advance_corners(starts, ends, 1e-6, device)
    assert clear.tolist() == (~meets).tolist() and not undecided.any() and 40 < meets.sum() < 120


@pytest.mark.parametrize("way", ["slides", "comes down"])
@pytest.mark.parametrize("gap, clear", [(2.0**-70, True), (2.0**-50, True), (0.0, False), (-(2.0**-50), False)])
def test_posed_meshes_come_as_near(gap, clear, way, device):
    """A box is that far above another at last, or all the time; poses hold the gap exactly, also in turned frames."""
    block = trimesh.creation.box(bounds=[[-1, -1, 0], [1, 2, 1]])
    top, base = ab.Model.load(block), ab.Model.load(block.apply_translation([0, 0, -1]))
    first = np.array([0, 0, 1.0 if way == "comes down" else gap])
    last = np.array([0.375, 0.5, gap])
    for turn, end_turn, axes in (((0, 0, 0, 1), (0, 0, 0.6, 0.8), [0, 1, 2]), ((0.5,) * 4, (0.5,) * 4, [2, 0, 1])):
        scene = scene_with(device, (base, (0, 0, 0, *turn)), (top, (*first[axes], *turn)))
        ends = np.array([(0, 0, 0, *turn), (*last[axes], *end_turn)])
        result = scene.first_contact([(0, 1)], ends, linear=True)
        assert result.clear[0] == clear and not result.undecided[0]
        if not clear:
            assert 1 - 1e-6 <= result.time[0] <= 1 if way == "comes down" else result.time[0] == 0


TOLERANCE = 1e-6


def soups_intersect(a, b):
    """Return whether corners (f, 3, 3) have a point in common, in integers."""
    pairs = box_pairs(a, b)
    corners = [np.arange(3 * len(soup)).reshape(-1, 3) for soup in (a, b)]
    return pairs_intersect(a.reshape(-1, 3), corners[0], b.reshape(-1, 3), corners[1], pairs).any()


def test_never_late_and_early_by_the_tolerance(device):
    cases, ends = random_motions(np.random.default_rng(1), 40, ("box", "small ball", "torus", "soup"), 40, 1.5)
    result = find(device, cases, ends, linear=True)
    assert not result.undecided.any() and 10 < result.clear.sum() < 35 and (result.time == 0).sum() < 10
    for case, path, time, clear in zip(cases, ends.reshape(-1, 2, 7), result.time, result.clear, strict=True):
        meshes = [model.mesh_at(lod)[:2] for model, lod in (case[:2], case[3:5])]
        place = straight_soups(meshes, (case[2], case[5]), path)
        for part in (0.0, 0.3, 0.6, 0.8, 0.9, 0.97, 0.999, 1.0) if time > 0 else ():
            assert not soups_intersect(*place(part * time))
        if not clear:
            assert soups_intersect(*place(min(time + TOLERANCE, 1.0) if time > 0 else 0.0))


def test_public_queries_are_told_from_contacts(device):
    """Ground truth in rational numbers; one of them comes within 2^-105 of its size."""
    files = sorted(FOLDER.glob("*.csv.gz"))
    if not files:
        pytest.skip("queries of continuous collision detection are not at hand; ABTREE_CCD names their folder")
    beyond = 0
    for path in files:
        starts, ends, truth = read_queries(path)
        _, clear, undecided = testing.advance_corners(starts, ends, TOLERANCE, device)
        assert not clear[truth].any() and not undecided.any()
        beyond += (~truth & ~clear).sum()
    assert beyond <= 1
