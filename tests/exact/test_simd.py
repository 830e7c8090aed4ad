"""Vector instructions of the CPU against the functions that every device runs, number by number."""

import math

import numpy as np
import pytest
import warp as wp
from helpers.samples import contact_poses, sample

import warp_abtree as ab
from warp_abtree.kernels.arithmetic.predicates import EXACT, FILTER, FLOAT32, UNCERTAIN
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal import face_pairs
from warp_abtree.kernels.traversal.face_pairs import face_plane_signs, intersect_straddling_faces
from warp_abtree.kernels.traversal.node_pair import (
    EMIT_ITEM,
    EMIT_LEAVES,
    compare_node_pair,
    first_item,
    item_first,
    item_second,
)
from warp_abtree.kernels.traversal.simd import (
    CPU_STACK_LENGTH,
    DEPTH_FIRST_LENGTH,
    ITEMS_AT_ONCE,
    WAITING_LENGTH,
    descend,
    simd_float32_filter,
    simd_float64_filter,
)
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, SEPARATED

pytestmark = pytest.mark.slow

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CPU = "cpu"
UNTOUCHED, OVER = -77, 16  # OVER: what vector instructions may write behind a list


# --- the float32 filter ----------------------------------------------------------------------------------------------


def pose_of(**fields):
    """Return an array of one `PairPose`."""
    pose = PairPose()
    for name, value in fields.items():
        setattr(pose, name, value)
    return wp.array([pose], dtype=PairPose, device=CPU)


def filled(count):
    return wp.full(count, UNTOUCHED, dtype=wp.int64, device=CPU)


def pool_of(field, points, corners):
    """Return the pools of points and of faces between them."""
    models, states = ModelPool(), StatePool()
    dtype = wp.vec4 if field == "vertex_near" else wp.vec4d
    setattr(models, field, wp.array(points, dtype=dtype, device=CPU))
    corners = np.pad(corners, ((0, 0), (0, 1))).astype(np.int32)
    states.face_corner = wp.array(corners, dtype=wp.vec4i, device=CPU)
    return models, states


@wp.kernel
def float32_one_kernel(
    mode: wp.int32,
    models: ModelPool,
    states: StatePool,
    poses: wp.array(dtype=PairPose),
    faces: wp.array(dtype=wp.int64),
    meet_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    a, b = item_first(faces[i]), item_second(faces[i])
    signs = face_plane_signs(mode, models, states, poses[0], a, b)
    meet = intersect_straddling_faces(mode, models, states, poses[0], a, b, signs)
    meet_out[i] = wp.where(signs == SEPARATED, 0, meet)


@wp.kernel
def float32_all_kernel(
    first_ends: wp.bool,
    unit: wp.float32,
    models: ModelPool,
    states: StatePool,
    poses: wp.array(dtype=PairPose),
    faces_inout: wp.array(dtype=wp.int64),
    uncertain_out: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    waiting, error = faces_inout.shape[0] - OVER, poses[0].error
    counts = simd_float32_filter(models, states, poses[0], error, unit, first_ends, waiting, faces_inout, uncertain_out)
    for i in range(3):
        count_out[i] = counts[i]


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
    models, states = pool_of("vertex_near", near_points(kind, rng, 90), rng.integers(0, 90, (2 * face_count, 3)))
    rotation, shift, scale = np.eye(3), np.zeros(3), 1.0
    if posed:
        rotation, shift, scale = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) / 9, 0.25
    fields = dict(rotation32=wp.mat33(rotation.astype(np.float32)), translation32=wp.vec3(*shift.astype(np.float32)))
    asked = rng.integers(0, face_count, (ask_count, 2))
    asked = (asked[:, 0] << 32) | asked[:, 1]
    seen = []
    for error in (0.0, 1e-6, 1e-2, np.inf, np.nan):
        placed = [models, states, pose_of(**fields, scale=scale, error=error, corner_b=face_count)]
        meet = wp.empty(ask_count, dtype=wp.int32, device=CPU)
        items = wp.array(asked, dtype=wp.int64, device=CPU)
        inputs = [FLOAT32 if error == 0.0 else EXACT, *placed, items, meet]
        wp.launch(float32_one_kernel, dim=ask_count, inputs=inputs, device=CPU)
        meet = meet.numpy()
        for first_ends in (False, True):
            faces = wp.array(np.append(asked, [UNTOUCHED] * OVER), dtype=wp.int64, device=CPU)
            left, counts = filled(ask_count + OVER), wp.zeros(3, dtype=wp.int64, device=CPU)
            inputs = [first_ends, 0.0 if error == 0.0 else float(FLOAT32_UNIT), *placed, faces, left, counts]
            wp.launch(float32_all_kernel, dim=1, inputs=inputs, device=CPU)
            met, uncertain, tested = counts.numpy()
            hit = np.flatnonzero(meet == 1)
            ends = first_ends and len(hit) > 0
            assert tested == (min(ask_count, 16 * (hit[0] // 16 + 1)) if ends else ask_count)
            np.testing.assert_array_equal(faces.numpy()[:met], asked[:tested][meet[:tested] == 1])
            np.testing.assert_array_equal(left.numpy()[:uncertain], asked[:tested][meet[:tested] == int(UNCERTAIN)])
            assert (left.numpy()[uncertain + OVER :] == UNTOUCHED).all()
            assert (faces.numpy()[16 * math.ceil(ask_count / 16) :] == UNTOUCHED).all()
        seen.append(np.bincount(meet, minlength=int(UNCERTAIN) + 1) > 0)
    assert seen[1][[0, 1, int(UNCERTAIN)]].all() or kind in ("coplanar", "wild")
    assert np.isin(meet, [0, int(UNCERTAIN)]).all(), "no sign is sure where the bound is no number"


# --- the float64 filter ----------------------------------------------------------------------------------------------


@wp.kernel
def float64_one_kernel(
    models: ModelPool,
    states: StatePool,
    poses: wp.array(dtype=PairPose),
    faces: wp.array(dtype=wp.int64),
    filter_out: wp.array(dtype=wp.int32),
    exact_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    face_a, face_b = item_first(faces[i]), item_second(faces[i])
    filter_out[i] = face_pairs.test_faces(FILTER, models, states, poses[0], face_a, face_b)
    exact_out[i] = face_pairs.test_faces(EXACT, models, states, poses[0], face_a, face_b)


@wp.kernel
def float64_all_kernel(
    first_ends: wp.bool,
    met: wp.int32,
    waiting: wp.int32,
    models: ModelPool,
    states: StatePool,
    poses: wp.array(dtype=PairPose),
    uncertain_inout: wp.array(dtype=wp.int64),
    faces_inout: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    counts = simd_float64_filter(models, states, poses[0], first_ends, met, waiting, uncertain_inout, faces_inout)
    for i in range(3):
        count_out[i] = counts[i]


def exact_points(kind, rng, count):
    """Return float64 (2 count, 3), of A and of B, and a pose: signs are sure, zero, lost in rounding, or no numbers."""
    a, b = rng.uniform(-1, 1, (2, count, 3))
    rotation, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) / 9
    if kind in ("lattice", "coplanar"):
        a, b = rng.integers(-1, 2, (2, count, 3)).astype(float)
        rotation, shift = np.eye(3)[[1, 2, 0]], np.array([1.0, 0, 0])
    if kind == "coplanar":
        a, b = a @ np.diag([1, 1, 0]), 3 * b @ np.diag([1, 0, 1])
        rotation, shift = np.eye(3)[[0, 2, 1]], np.zeros(3)
    elif kind in ("coincident", "nearly coincident"):
        b, rotation, shift = a.copy(), np.eye(3), np.zeros(3)
        if kind == "nearly coincident":
            b += rng.integers(-2, 3, b.shape) * np.spacing(b)
    elif kind == "coincident, turned":
        b = (a - shift) @ rotation
    elif kind == "nearly coplanar":
        for x in (a, b):
            x[:, 2] = 0.1 * x[:, 0] + 0.3 * x[:, 1] + 1e-15 * rng.normal(size=count)
        rotation, shift = np.eye(3), np.zeros(3)
    elif kind == "tiny":  # about 2^-290, below which a posed coordinate is 0
        size = 2.0 ** rng.integers(-292, -287, (2, count, 1))
        a, b = rng.integers(-3, 4, (2, count, 3)) * size
        a[np.abs(a) < 2.0**-290] = 0.0
        rotation, shift = np.eye(3), np.zeros(3)
    elif kind == "huge":
        a, b, shift = 2.0**330 * a, 2.0**330 * b, 2.0**327 * shift
    elif kind == "wild":
        a, b = (x * 10.0 ** rng.integers(-300, 300, (count, 1)) for x in (a, b))
        a[rng.random(count) < 0.02], b[rng.random(count) < 0.02] = np.inf, np.nan
    return np.concatenate([a, b]), rotation, shift


# What must turn up.
CASES = {
    "random": "met apart",
    "lattice": "met apart left",
    "coplanar": "left",
    "coincident": "met apart",
    "nearly coincident": "met apart",
    "coincident, turned": "met apart",
    "nearly coplanar": "apart left",
    "tiny": "met apart left",
    "huge": "met apart",
    "wild": "apart left",
    "degenerate": "met apart left",
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
        one, other = np.nonzero(shares)
        chosen = rng.integers(0, len(one), ask_count // 2)
        asked[: ask_count // 2] = np.stack([one[chosen], other[chosen]], 1)
    return points, corners, rotation, shift, asked


@pytest.mark.parametrize("kind", CASES)
def test_float64_filter_is_the_same_as_one_by_one(kind):
    rng = np.random.default_rng(11)
    count, face_count, ask_count, before = 40, 150, 2053, 3  # no multiple of 8
    points, corners, rotation, shift, asked = float64_case(kind, rng, count, face_count, ask_count)
    pose = pose_of(rotation=wp.mat33d(rotation), translation=wp.vec3d(*shift), corner_b=face_count)
    placed = [*pool_of("vertex_pos", np.pad(points, ((0, 0), (0, 1))), corners), pose]
    asked = (asked[:, 0] << 32) | asked[:, 1]
    plain, exact = (wp.empty(ask_count, dtype=wp.int32, device=CPU) for _ in range(2))
    items = wp.array(asked, dtype=wp.int64, device=CPU)
    wp.launch(float64_one_kernel, dim=ask_count, inputs=[*placed, items, plain, exact], device=CPU)
    plain, exact = plain.numpy(), exact.numpy()
    met, uncertain = plain == 1, plain == int(UNCERTAIN)
    with np.errstate(invalid="ignore"):
        x, y, z = (points[:, k : k + 1] * rotation[:, k] for k in range(3))
        posed = ((x + y) + z) + shift
    a, b = corners[asked >> 32], corners[face_count + (asked & 0xFFFFFFFF)]
    shared = (points[a][:, :, None] == posed[b][:, None]).all(-1).any((1, 2))
    assert not uncertain[shared].any(), "corners in common decide what the signs do not"
    assert (plain[~uncertain] == exact[~uncertain]).all() or kind == "wild"
    # As they come, and the uncertain ones first, so that a search for a first hit gets that far.
    for first_ends, order in ((False, np.s_[:]), (True, np.s_[:]), (True, np.argsort(~uncertain, kind="stable"))):
        items, hit, inexact = asked[order], met[order], uncertain[order]
        left = wp.array(np.append(items, [UNTOUCHED] * OVER), dtype=wp.int64, device=CPU)
        faces, counts = filled(before + ask_count + OVER), wp.zeros(3, dtype=wp.int64, device=CPU)
        inputs = [first_ends, before, ask_count, *placed, left, faces, counts]
        wp.launch(float64_all_kernel, dim=1, inputs=inputs, device=CPU)
        end, still_open, tested = counts.numpy()
        ends = first_ends and hit.any()
        assert tested == (min(ask_count, 8 * (np.flatnonzero(hit)[0] // 8 + 1)) if ends else ask_count)
        first = np.arange(ask_count) < tested
        np.testing.assert_array_equal(np.sort(faces.numpy()[before:end]), np.sort(items[first & hit]))
        np.testing.assert_array_equal(np.sort(left.numpy()[:still_open]), np.sort(items[first & inexact]))
        assert (faces.numpy()[:before] == UNTOUCHED).all() and (faces.numpy()[end + 8 :] == UNTOUCHED).all()
        assert (left.numpy()[ask_count + 8 :] == UNTOUCHED).all()
    seen = {"met": met, "apart": plain == 0, "left": uncertain}
    assert all(seen[name].sum() > 30 for name in CASES[kind].split())


# --- the traversal ---------------------------------------------------------------------------------------------------


@wp.kernel
def compare_all_kernel(
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    stack_inout: wp.array(dtype=wp.int64),
    found_out: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    """Traverse pair 0 by `compare_node_pair`, one item at a time."""
    pose = pair_poses[0]
    stack_inout[0] = first_item(states, pose)
    top, found, compared = wp.int32(1), wp.int32(0), wp.int32(0)
    while top > 0:
        top -= 1
        items, emitted, tests = compare_node_pair(states, pose, stack_inout[top], -1)
        compared += tests
        for k in range(4):
            if emitted[k] == EMIT_ITEM:
                stack_inout[top] = items[k]
                top += 1
            if emitted[k] == EMIT_LEAVES:
                found_out[found] = items[k]
                found += 1
    count_out[0] = wp.int64(found)
    count_out[1] = wp.int64(compared)


@wp.kernel
def descend_kernel(
    at_once: wp.int32,
    ready: wp.int32,
    times: wp.int32,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    stack_inout: wp.array(dtype=wp.int64),
    faces_inout: wp.array(dtype=wp.int64),
    found_out: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    """Traverse pair 0 so many times at once."""
    pose = pair_poses[0]
    root = first_item(states, pose)
    for i in range(times):
        stack_inout[i] = root
    top, found, compared = wp.int32(times), wp.int32(0), wp.int64(0)
    while top > 0:
        progress = descend(states, pose, at_once, ready, wp.int64(2**40), top, stack_inout, faces_inout)
        top = wp.int32(progress[0])
        compared += progress[2]
        for i in range(wp.int32(progress[1])):
            found_out[found] = faces_inout[i]
            found += 1
    count_out[0] = wp.int64(found)
    count_out[1] = compared


def traverse(kernel, scalars, query, lengths, room):
    """Return the leaf pairs found, sorted, the pairs of boxes compared, and the buffers."""
    buffers = [filled(length) for length in lengths]
    found, counts = wp.empty(room, dtype=wp.int64, device=CPU), wp.zeros(2, dtype=wp.int64, device=CPU)
    inputs = [*scalars, query.batch.pools[1], query.pair_poses, *buffers, found, counts]
    wp.launch(kernel, dim=1, inputs=inputs, device=CPU)
    count, compared = counts.numpy()
    return np.sort(found.numpy()[:count]), int(compared), [buffer.numpy() for buffer in buffers]


def launched(*objects):
    """Return a query that has asked about two objects (model, pose, LOD), and what `traverse` finds one by one."""
    scene = ab.Scene(CPU)
    for model, pose, lod in objects:
        scene.add(model, pose, lod=lod)
    query = ab.Query(scene, "faces", pairs=[(0, 1)])
    query.launch()
    plain, compared, _ = traverse(compare_all_kernel, [], query, [4096], 10**6)
    assert compared == query.hits.node_tests.numpy()[0] and len(plain) == query.hits.triangle_tests.numpy()[0] > 0
    return query, plain, compared


@pytest.mark.parametrize("names", [("torus", "torus"), ("soup", "torus"), ("torus", "soup")], ids="-".join)
def test_descends_as_node_pair_tests_do(names):
    """The same pairs of boxes and faces, whatever is taken at once, in any order and at any level of detail."""
    a, b = (sample(name) for name in names)
    for lods in ((a.lod_max, b.lod_max), (a.lod_for(fraction=0.3), b.lod_for(fraction=0.1)), (0, b.lod_max)):
        poses = contact_poses(np.random.default_rng(7), a, lods[0], b, lods[1])
        query, plain, compared = launched((a, poses[0], lods[0]), (b, poses[1], lods[1]))
        for at_once in (1, 2, 7, ITEMS_AT_ONCE):
            for ready in (1, WAITING_LENGTH - 4 * ITEMS_AT_ONCE - 4):
                lengths = [CPU_STACK_LENGTH + 1, WAITING_LENGTH + 1]
                found, tested, _ = traverse(descend_kernel, [at_once, ready, 1], query, lengths, 10**6)
                np.testing.assert_array_equal(found, plain)
                assert tested == compared


def test_descends_in_little_room():
    """A stack that starts full is worked off one item at a time, and nothing is written behind it."""
    model = sample("torus")
    twin = model, (0, 0, 0, 0, 0, 0, 1), model.lod_for(fraction=0.2)
    query, plain, compared = launched(twin, twin)
    times = CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH
    lengths, room = [CPU_STACK_LENGTH + 64, WAITING_LENGTH + 64], times * len(plain)
    found, tested, (stack, faces) = traverse(descend_kernel, [ITEMS_AT_ONCE, 100, times], query, lengths, room)
    np.testing.assert_array_equal(found, np.repeat(plain, times))
    assert tested == times * compared
    assert (stack[CPU_STACK_LENGTH:] == UNTOUCHED).all() and stack[times] != UNTOUCHED
    assert (faces[WAITING_LENGTH:] == UNTOUCHED).all()
