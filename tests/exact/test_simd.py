"""Vector instructions of the CPU against the functions that every device runs, number by number."""

import math

import numpy as np
import pytest
import warp as wp
from helpers.questions import GpuQuery, scene_of
from helpers.samples import STILL, contact_poses, sample

from warp_abtree import testing
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.exact.predicates import EXACT, FILTER, FLOAT32, UNCERTAIN
from warp_abtree.kernels.intersect import face_pairs
from warp_abtree.kernels.intersect.face_pairs import face_plane_signs, intersect_straddling_faces
from warp_abtree.kernels.intersect.simd import simd_float32_filter, simd_float64_filter
from warp_abtree.kernels.search import descent
from warp_abtree.kernels.search.descent import CPU_STACK_LENGTH, ITEMS_AT_ONCE, WAITING_LENGTH
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.thread_search import FaceLists, make_lists
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT
from warp_abtree.kernels.triangle.signs import SEPARATED

pytestmark = pytest.mark.slow

HEADERS = "intersect/float32_filter.h", "intersect/float64_filter.h", "triangle/float32_filter.cuh"
wp.set_module_options(native.options("base/lanes.cuh", "exact/determinant.cuh", "search/descend.h", *HEADERS))

CPU = "cpu"
UNTOUCHED, OVER = -77, 16  # OVER: what vector instructions may write behind a list
Items = wp.array[wp.int64]


@wp.struct
class Posed:
    trees: Trees  # vertices and faces of both
    pose: PairPose  # of B in A's frame


def posed_faces(field, points, corners, **pose):
    """Return faces between points, which a field of the models holds, with fields of a pose."""
    made, kind = Posed(), wp.vec4 if field == "vertex_near" else wp.vec4d
    setattr(made.trees.models, field, wp.array(points, dtype=kind, device=CPU))
    corners = np.pad(corners, ((0, 0), (0, 1))).astype(np.int32)
    made.trees.states.face_corner = wp.array(corners, dtype=wp.vec4i, device=CPU)
    for name, value in pose.items():
        setattr(made.pose, name, value)
    return made


def filled(count, items=()):
    """Return an array of items with so many places behind them that nothing has touched."""
    return wp.array(np.append(items, np.full(count, UNTOUCHED)), dtype=wp.int64, device=CPU)


def ask_one_by_one(kernel, *inputs, items):
    """Return the answers of a kernel about each face pair."""
    answers = wp.empty((2, len(items)), dtype=wp.int32, device=CPU)
    wp.launch(kernel, len(items), [*inputs, filled(0, items), answers], device=CPU)
    return answers.numpy()


def ask_at_once(kernel, *inputs):
    """Return the counts of a kernel of one thread."""
    counts = wp.zeros(4, dtype=wp.int64, device=CPU)
    wp.launch(kernel, 1, [*inputs, counts], device=CPU)
    return counts.numpy()


@wp.kernel
def float32_one_kernel(mode: int, posed: Posed, items: Items, meet_out: wp.array2d[int]):
    i = wp.tid()
    a, b = item_first(items[i]), item_second(items[i])
    signs = face_plane_signs(mode, posed.trees, posed.pose, a, b)
    meet = intersect_straddling_faces(mode, posed.trees, posed.pose, a, b, signs)
    meet_out[0, i] = wp.where(signs == SEPARATED, 0, meet)


@wp.func
def write_filtered(found: FaceLists, count: Items):
    count[0] = wp.int64(found.met)
    count[1] = wp.int64(found.uncertain)
    count[2] = wp.int64(found.tested)
    count[3] = wp.int64(found.apart)


@wp.kernel
def float32_all_kernel(first_ends: bool, unit: float, posed: Posed, faces_inout: Items, left_out: Items, count: Items):
    found = make_lists(faces_inout, left_out, left_out)
    found.waiting = faces_inout.shape[0] - OVER
    simd_float32_filter(posed.trees, posed.pose, wp.vec3(posed.pose.error, unit, -1.0), first_ends, found)
    write_filtered(found, count)


def near_points(kind, rng, count):
    """Return float32 (count, 4), on which signs are sure, zero, lost in rounding, or no numbers."""
    points = rng.uniform(-1, 1, (count, 3))
    if kind == "lattice":
        points = rng.integers(-1, 2, (count, 3)).astype(float)
    elif kind == "coplanar":
        points[:, 2] = 1e-7 * points[:, 2]
    elif kind == "wild":
        points = points * 10.0 ** rng.integers(-44, 39, (count, 1))
        points[rng.random(count) < 0.02] = np.inf
        points[rng.random(count) < 0.02] = np.nan
    return np.pad(points, ((0, 0), (0, 1))).astype(np.float32)


@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("kind", ["random", "lattice", "coplanar", "wild"])
def test_float32_filter_is_the_same_as_one_by_one(kind, posed):
    rng = np.random.default_rng(5)
    face_count, ask_count = 200, 3011  # no multiple of 16
    faces = "vertex_near", near_points(kind, rng, 90), rng.integers(0, 90, (2 * face_count, 3))
    rotation, shift, scale = np.eye(3), np.zeros(3), 1.0
    if posed:
        rotation, shift, scale = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) / 9, 0.25
    fields = dict(rotation32=wp.mat33(rotation.astype(np.float32)), translation32=wp.vec3(*shift.astype(np.float32)))
    asked = rng.integers(0, face_count, (ask_count, 2)) @ [2**32, 1]
    seen = []
    for error in (0.0, 1e-6, 1e-2, np.inf, np.nan):
        placed = posed_faces(*faces, **fields, scale=scale, error=error, corner_b=face_count)
        meet = ask_one_by_one(float32_one_kernel, FLOAT32 if error == 0.0 else EXACT, placed, items=asked)[0]
        for first_ends in (False, True):
            items, left = filled(OVER, asked), filled(ask_count + OVER)
            unit = 0.0 if error == 0.0 else float(FLOAT32_UNIT)
            met, uncertain, tested, _ = ask_at_once(float32_all_kernel, first_ends, unit, placed, items, left)
            hit = np.flatnonzero(meet == 1)
            ends = first_ends and len(hit) > 0
            assert tested == (min(ask_count, 16 * (hit[0] // 16 + 1)) if ends else ask_count)
            np.testing.assert_array_equal(items.numpy()[:met], asked[:tested][meet[:tested] == 1])
            np.testing.assert_array_equal(left.numpy()[:uncertain], asked[:tested][meet[:tested] == int(UNCERTAIN)])
            assert (left.numpy()[uncertain + OVER :] == UNTOUCHED).all()
            assert (items.numpy()[16 * math.ceil(ask_count / 16) :] == UNTOUCHED).all()
        seen.append(np.bincount(meet, minlength=int(UNCERTAIN) + 1) > 0)
    assert seen[1][[0, 1, int(UNCERTAIN)]].all() or kind in ("coplanar", "wild")
    assert np.isin(meet, [0, int(UNCERTAIN)]).all(), "no sign is sure where the bound is no number"


@wp.kernel
def float64_one_kernel(posed: Posed, items: Items, meet_out: wp.array2d[int]):
    i = wp.tid()
    a, b = item_first(items[i]), item_second(items[i])
    meet_out[0, i] = face_pairs.test_faces(FILTER, posed.trees, posed.pose, a, b)
    meet_out[1, i] = face_pairs.test_faces(EXACT, posed.trees, posed.pose, a, b)


@wp.kernel
def float64_all_kernel(
    first_ends: bool, met: int, waiting: int, posed: Posed, left: Items, faces: Items, apart: Items, count: Items
):
    """Filter so many face pairs, and list those that are apart where the first that meets does not end it."""
    found = make_lists(faces, left, apart)
    found.met = met
    found.apart = met
    found.uncertain = waiting
    simd_float64_filter(posed.trees, posed.pose, first_ends, not first_ends, found)
    write_filtered(found, count)


def exact_points(kind, rng, count):
    """Return float64 (2 count, 3), of A and of B, and a pose: signs are sure, zero, lost in rounding, or no numbers."""
    a, b = rng.uniform(-1, 1, (2, count, 3))
    rotation, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) / 9
    if kind in ("coincident", "nearly coincident", "nearly coplanar", "tiny"):
        rotation, shift = np.eye(3), np.zeros(3)
    if kind in ("lattice", "coplanar"):
        a, b = rng.integers(-1, 2, (2, count, 3)).astype(float)
        rotation, shift = np.eye(3)[[1, 2, 0]], np.array([1.0, 0, 0])
    if kind == "coplanar":
        a, b = a @ np.diag([1, 1, 0]), 3 * b @ np.diag([1, 0, 1])
        rotation, shift = np.eye(3)[[0, 2, 1]], np.zeros(3)
    elif kind in ("coincident", "nearly coincident"):
        b = a + (rng.integers(-2, 3, b.shape) * np.spacing(a) if kind == "nearly coincident" else 0)
    elif kind == "coincident, turned":
        b = (a - shift) @ rotation
    elif kind == "nearly coplanar":
        for x in (a, b):
            x[:, 2] = 0.1 * x[:, 0] + 0.3 * x[:, 1] + 1e-15 * rng.normal(size=count)
    elif kind == "tiny":  # about 2^-290, below which a posed coordinate is 0
        a, b = rng.integers(-3, 4, (2, count, 3)) * 2.0 ** rng.integers(-292, -287, (2, count, 1))
        a[np.abs(a) < 2.0**-290] = 0.0
    elif kind == "huge":
        a, b, shift = 2.0**330 * a, 2.0**330 * b, 2.0**327 * shift
    elif kind == "wild":
        a, b = (x * 10.0 ** rng.integers(-300, 300, (count, 1)) for x in (a, b))
        a[rng.random(count) < 0.02], b[rng.random(count) < 0.02] = np.inf, np.nan
    return np.concatenate([a, b]), rotation, shift


# What must turn up, and where.
SEEN = {
    "met apart": ("random", "coincident", "nearly coincident", "coincident, turned", "huge"),
    "met apart left": ("lattice", "tiny", "degenerate"),
    "apart left": ("nearly coplanar", "wild"),
    "left": ("coplanar",),
}


def float64_case(kind, rng, count, face_count, ask_count):
    """Return corners' points (2 count, 3) and ids, a rotation, a shift, and face pairs asked."""
    points, rotation, shift = exact_points(kind, rng, count)
    corners = np.array([rng.choice(count, 3, replace=kind == "degenerate") for _ in range(2 * face_count)])
    if "coincident" in kind:
        corners[face_count:] = corners[:face_count]
    corners[face_count:] += count
    asked = rng.integers(0, face_count, (ask_count, 2))
    if "coincident" in kind:
        # Half of them neighbours.
        shares = (corners[:face_count, None, :, None] + count == corners[face_count:].reshape(1, -1, 1, 3)).any((2, 3))
        asked[: ask_count // 2] = rng.choice(np.argwhere(shares), ask_count // 2)
    return points, corners, rotation, shift, asked


@pytest.mark.parametrize(("kind", "outcomes"), [(kind, outcomes) for outcomes in SEEN for kind in SEEN[outcomes]])
def test_float64_filter_is_the_same_as_one_by_one(kind, outcomes):
    rng = np.random.default_rng(11)
    count, face_count, ask_count, before = 40, 150, 2053, 3  # no multiple of 8
    points, corners, rotation, shift, asked = float64_case(kind, rng, count, face_count, ask_count)
    pose = dict(rotation=wp.mat33d(rotation), translation=wp.vec3d(*shift), corner_b=face_count)
    placed = posed_faces("vertex_pos", np.pad(points, ((0, 0), (0, 1))), corners, **pose)
    a, b = corners[asked[:, 0]], corners[face_count + asked[:, 1]]
    asked = asked @ [2**32, 1]
    plain, exact = ask_one_by_one(float64_one_kernel, placed, items=asked)
    met, uncertain = plain == 1, plain == int(UNCERTAIN)
    with np.errstate(invalid="ignore"):
        x, y, z = (points[:, k : k + 1] * rotation[:, k] for k in range(3))
        moved = ((x + y) + z) + shift
    shared = (points[a][:, :, None] == moved[b][:, None]).all(-1).any((1, 2))
    assert not uncertain[shared].any(), "corners in common decide what the signs do not"
    assert (plain[~uncertain] == exact[~uncertain]).all() or kind == "wild"
    # As they come, and the uncertain ones first, so that a search for a first hit gets that far.
    for first_ends, order in ((False, np.s_[:]), (True, np.s_[:]), (True, np.argsort(~uncertain, kind="stable"))):
        items, hit, inexact = asked[order], met[order], uncertain[order]
        left, (faces, apart) = filled(OVER, items), (filled(before + ask_count + OVER) for _ in range(2))
        inputs = first_ends, before, ask_count, placed, left, faces, apart
        end, still_open, tested, apart_end = ask_at_once(float64_all_kernel, *inputs)
        ends = first_ends and hit.any()
        assert tested == (min(ask_count, 8 * (np.flatnonzero(hit)[0] // 8 + 1)) if ends else ask_count)
        first = np.arange(ask_count) < tested
        np.testing.assert_array_equal(np.sort(faces.numpy()[before:end]), np.sort(items[first & hit]))
        np.testing.assert_array_equal(np.sort(left.numpy()[:still_open]), np.sort(items[first & inexact]))
        assert (faces.numpy()[:before] == UNTOUCHED).all() and (faces.numpy()[end + 8 :] == UNTOUCHED).all()
        assert (left.numpy()[ask_count + 8 :] == UNTOUCHED).all()
        found = apart.numpy()
        if first_ends:
            assert (found == UNTOUCHED).all()
        else:
            np.testing.assert_array_equal(np.sort(found[before:apart_end]), np.sort(items[~hit & ~inexact]))
            assert (found[:before] == UNTOUCHED).all() and (found[apart_end + 8 :] == UNTOUCHED).all()
    seen = {"met": met, "apart": plain == 0, "left": uncertain}
    assert all(seen[name].sum() > 30 for name in outcomes.split())


@wp.kernel
def descend_kernel(
    how: wp.vec3i, states: StatePool, pose: wp.array[PairPose], stack: Items, faces: Items, found: Items, counts: Items
):
    """Traverse pair 0 many times at once; `how` many, items at a time, and leaf pairs until it pauses."""
    root = first_item(states, pose[0])
    for i in range(how[0]):
        stack[i] = root
    state = descent.Descent()
    state.top = how[0]
    state.at_once = how[1]
    state.ready = how[2]
    while state.top > 0:
        waiting = descent.descend(states, pose[0], descent.NEVER, state, stack, faces)
        for i in range(waiting):
            found[wp.int32(counts[0]) + i] = faces[i]
        counts[0] = counts[0] + wp.int64(waiting)
    counts[1] = state.tests


@pytest.mark.parametrize("names", [("torus", "torus"), ("soup", "torus"), ("torus", "soup")], ids="-".join)
def test_descends_as_node_pair_tests_do(names):
    a, b = (sample(name) for name in names)
    cases = [(a, a.lod_for(fraction=0.2), STILL) * 2]
    for lods in ((a.lod_max, b.lod_max), (a.lod_for(fraction=0.3), b.lod_for(fraction=0.1)), (0, b.lod_max)):
        pose_a, pose_b = contact_poses(np.random.default_rng(7), a, lods[0], b, lods[1])
        cases.append((a, lods[0], pose_a, b, lods[1], pose_b))
    most = WAITING_LENGTH - 4 * ITEMS_AT_ONCE - 4
    ways = [(1, taken, ready) for taken in (1, 2, 7, ITEMS_AT_ONCE) for ready in (1, most)]
    full = CPU_STACK_LENGTH - descent.DEPTH_FIRST_LENGTH, ITEMS_AT_ONCE, 100  # worked off one item at a time
    for case in cases:
        with testing.regime(small_faces=0, slabs=False):  # which takes items one by one
            query = GpuQuery(scene_of(CPU, [case]), "faces", pairs=[(0, 1)])
        result, plain = query.run(), None
        for way in [*ways, full] if case is cases[0] else ways:
            stack, faces = filled(CPU_STACK_LENGTH + 64), filled(WAITING_LENGTH + 64)
            found = wp.empty(10**7, dtype=wp.int64, device=CPU)
            inputs = wp.vec3i(*way), query.batch.states.pool, query.pair_poses, stack, faces, found
            count, compared, *_ = ask_at_once(descend_kernel, *inputs)
            assert count == way[0] * result.triangle_tests[0] > 0
            if plain is None:
                plain, tests = np.sort(found.numpy()[:count]), compared
            assert compared == way[0] * tests > 0
            np.testing.assert_array_equal(np.sort(found.numpy()[:count]), np.repeat(plain, way[0]))
            assert (stack.numpy()[CPU_STACK_LENGTH:] == UNTOUCHED).all() and stack.numpy()[way[0]] != UNTOUCHED
            assert (faces.numpy()[WAITING_LENGTH:] == UNTOUCHED).all(), "nothing is written behind the lists"
