"""The vector instructions of the CPU beside the plain functions that every device runs, number by number."""

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
from warp_abtree.kernels.traversal.warp_stack import take_slots
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, SEPARATED

pytestmark = pytest.mark.slow

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CPU = "cpu"
UNTOUCHED = -77
OVER = 16  # what vector instructions may write behind a list


# --- the float32 stage -----------------------------------------------------------------------------------------------


@wp.func
def made_pose(rotation: wp.mat33, translation: wp.vec3, scale: wp.float64, error: wp.float32, corner_b: wp.int32):
    pose = PairPose()
    pose.rotation32 = rotation
    pose.translation32 = translation
    pose.scale = scale
    pose.error = error
    pose.corner_b = corner_b
    return pose


@wp.kernel
def screen_one_kernel(
    mode: wp.int32,
    models: ModelPool,
    states: StatePool,
    rotation: wp.mat33,
    translation: wp.vec3,
    scale: wp.float64,
    error: wp.float32,
    corner_b: wp.int32,
    faces: wp.array(dtype=wp.int64),
    meet_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    pose = made_pose(rotation, translation, scale, error, corner_b)
    a, b = item_first(faces[i]), item_second(faces[i])
    signs = face_plane_signs(mode, models, states, pose, a, b)
    meet_out[i] = wp.where(signs == SEPARATED, 0, intersect_straddling_faces(mode, models, states, pose, a, b, signs))


@wp.kernel
def screen_all_kernel(
    first_ends: wp.bool,
    error: wp.float32,
    unit: wp.float32,
    models: ModelPool,
    states: StatePool,
    rotation: wp.mat33,
    translation: wp.vec3,
    scale: wp.float64,
    corner_b: wp.int32,
    faces_inout: wp.array(dtype=wp.int64),
    open_out: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    pose = made_pose(rotation, translation, scale, error, corner_b)
    waiting = faces_inout.shape[0] - OVER
    counts = simd_float32_filter(models, states, pose, error, unit, first_ends, waiting, faces_inout, open_out)
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


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", ["random", "lattice", "coplanar", "wild"])
def test_screens_the_same_as_one_by_one(kind, turned):
    rng = np.random.default_rng(5)
    face_count, ask_count = 200, 3011  # no multiple of 16
    models, states = ModelPool(), StatePool()
    models.vertex_near = wp.array(near_points(kind, rng, 90), dtype=wp.vec4, device=CPU)
    corners = np.pad(rng.integers(0, 90, (2 * face_count, 3)), ((0, 0), (0, 1))).astype(np.int32)
    states.face_corner = wp.array(corners, dtype=wp.vec4i, device=CPU)
    rotation, shift, scale = np.eye(3), np.zeros(3), 1.0
    if turned:
        rotation, shift, scale = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) / 9, 0.25
    placed = [wp.mat33(rotation.astype(np.float32)), wp.vec3(*shift.astype(np.float32)), scale]
    asked = rng.integers(0, face_count, (ask_count, 2))
    asked = (asked[:, 0] << 32) | asked[:, 1]
    seen = []
    for error in (0.0, 1e-6, 1e-2, np.inf, np.nan):
        mode = FLOAT32 if error == 0.0 else EXACT
        meet = wp.empty(ask_count, dtype=wp.int32, device=CPU)
        items = wp.array(asked, dtype=wp.int64, device=CPU)
        inputs = [mode, models, states, *placed, error, face_count, items, meet]
        wp.launch(screen_one_kernel, dim=ask_count, inputs=inputs, device=CPU)
        meet = meet.numpy()
        for first_ends in (False, True):
            faces = wp.array(np.append(asked, [UNTOUCHED] * OVER), dtype=wp.int64, device=CPU)
            left = filled(ask_count + OVER)
            counts = wp.zeros(3, dtype=wp.int64, device=CPU)
            unit = 0.0 if error == 0.0 else float(FLOAT32_UNIT)
            inputs = [first_ends, error, unit, models, states, *placed, face_count, faces, left, counts]
            wp.launch(screen_all_kernel, dim=1, inputs=inputs, device=CPU)
            met, unsure, tested = counts.numpy()
            hit = np.flatnonzero(meet == 1)
            ends = first_ends and len(hit) > 0
            assert tested == (min(ask_count, 16 * (hit[0] // 16 + 1)) if ends else ask_count)
            np.testing.assert_array_equal(faces.numpy()[:met], asked[:tested][meet[:tested] == 1])
            np.testing.assert_array_equal(left.numpy()[:unsure], asked[:tested][meet[:tested] == int(UNCERTAIN)])
            assert (left.numpy()[unsure + OVER :] == UNTOUCHED).all()
            assert (faces.numpy()[16 * math.ceil(ask_count / 16) :] == UNTOUCHED).all()
        seen.append(np.bincount(meet, minlength=int(UNCERTAIN) + 1) > 0)
    assert seen[1][[0, 1, int(UNCERTAIN)]].all() or kind in ("coplanar", "wild")
    assert np.isin(meet, [0, int(UNCERTAIN)]).all(), "no sign is sure where the bound is no number"


# --- the float64 stage -----------------------------------------------------------------------------------------------


@wp.func
def pose64(rotation: wp.mat33d, translation: wp.vec3d, corner_b: wp.int32):
    pose = PairPose()
    pose.rotation = rotation
    pose.translation = translation
    pose.corner_b = corner_b
    return pose


@wp.kernel
def filter_one_kernel(
    models: ModelPool,
    states: StatePool,
    rotation: wp.mat33d,
    translation: wp.vec3d,
    corner_b: wp.int32,
    faces: wp.array(dtype=wp.int64),
    filter_out: wp.array(dtype=wp.int32),
    exact_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    pose = pose64(rotation, translation, corner_b)
    face_a, face_b = item_first(faces[i]), item_second(faces[i])
    filter_out[i] = face_pairs.test_faces(FILTER, models, states, pose, face_a, face_b)
    exact_out[i] = face_pairs.test_faces(EXACT, models, states, pose, face_a, face_b)


@wp.kernel
def filter_all_kernel(
    first_ends: wp.bool,
    met: wp.int32,
    waiting: wp.int32,
    models: ModelPool,
    states: StatePool,
    rotation: wp.mat33d,
    translation: wp.vec3d,
    corner_b: wp.int32,
    open_inout: wp.array(dtype=wp.int64),
    faces_inout: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    pose = pose64(rotation, translation, corner_b)
    counts = simd_float64_filter(models, states, pose, first_ends, met, waiting, open_inout, faces_inout)
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


# What must turn up: pairs that meet, that are apart, and that are left open.
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


@pytest.mark.parametrize("kind", CASES)
def test_filters_the_same_as_one_by_one(kind):
    rng = np.random.default_rng(11)
    count, face_count, ask_count, before = 40, 150, 2053, 3  # no multiple of 8
    points, rotation, shift = exact_points(kind, rng, count)
    models, states = ModelPool(), StatePool()
    models.vertex_pos = wp.array(np.pad(points, ((0, 0), (0, 1))), dtype=wp.vec4d, device=CPU)
    corners = np.array([rng.choice(count, 3, replace=kind == "degenerate") for _ in range(2 * face_count)])
    if "coincident" in kind:
        corners[face_count:] = corners[:face_count]
    corners[face_count:] += count
    corners = np.pad(corners, ((0, 0), (0, 1))).astype(np.int32)
    states.face_corner = wp.array(corners, dtype=wp.vec4i, device=CPU)
    placed = [models, states, wp.mat33d(rotation), wp.vec3d(*shift), face_count]
    asked = rng.integers(0, face_count, (ask_count, 2))
    if "coincident" in kind:
        # Half of them neighbours.
        shares = (corners[:, None, :3, None] + count == corners[face_count:, None, :3].reshape(1, -1, 1, 3)).any((2, 3))
        one, other = np.nonzero(shares[:face_count])
        chosen = rng.integers(0, len(one), ask_count // 2)
        asked[: ask_count // 2] = np.stack([one[chosen], other[chosen]], 1)
    asked = (asked[:, 0] << 32) | asked[:, 1]
    plain, exact = (wp.empty(ask_count, dtype=wp.int32, device=CPU) for _ in range(2))
    items = wp.array(asked, dtype=wp.int64, device=CPU)
    wp.launch(filter_one_kernel, dim=ask_count, inputs=[*placed, items, plain, exact], device=CPU)
    plain, exact = plain.numpy(), exact.numpy()
    met, unsure = plain == 1, plain == int(UNCERTAIN)
    with np.errstate(invalid="ignore"):
        x, y, z = (points[:, k : k + 1] * rotation[:, k] for k in range(3))
        posed = ((x + y) + z) + shift
    a, b = corners[asked >> 32, :3], corners[face_count + (asked & 0xFFFFFFFF), :3]
    joined = (points[a][:, :, None] == posed[b][:, None]).all(-1).any((1, 2))
    assert not unsure[joined].any(), "corners in common decide what the signs leave open"
    assert (plain[~unsure] == exact[~unsure]).all() or kind == "wild"
    # As they come, and those first that are left open, so that a search for a first hit gets that far.
    came = np.arange(ask_count)
    for first_ends, order in ((False, came), (True, came), (True, np.argsort(~unsure, kind="stable"))):
        items, hit, hard = asked[order], met[order], unsure[order]
        left = wp.array(np.append(items, [UNTOUCHED] * OVER), dtype=wp.int64, device=CPU)
        faces, counts = filled(before + ask_count + OVER), wp.zeros(3, dtype=wp.int64, device=CPU)
        inputs = [first_ends, before, ask_count, *placed, left, faces, counts]
        wp.launch(filter_all_kernel, dim=1, inputs=inputs, device=CPU)
        end, still_open, tested = counts.numpy()
        ends = first_ends and hit.any()
        assert tested == (min(ask_count, 8 * (np.flatnonzero(hit)[0] // 8 + 1)) if ends else ask_count)
        first = np.arange(ask_count) < tested
        np.testing.assert_array_equal(np.sort(faces.numpy()[before:end]), np.sort(items[first & hit]))
        np.testing.assert_array_equal(np.sort(left.numpy()[:still_open]), np.sort(items[first & hard]))
        assert (faces.numpy()[:before] == UNTOUCHED).all() and (faces.numpy()[end + 8 :] == UNTOUCHED).all()
        assert (left.numpy()[ask_count + 8 :] == UNTOUCHED).all()
    seen = {"met": met, "apart": plain == 0, "left": unsure}
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
        items, steps, tests = compare_node_pair(states, pose, stack_inout[top], -1)
        compared += tests
        for k in range(4):
            if steps[k] == EMIT_ITEM:
                stack_inout[top] = items[k]
                top += 1
            if steps[k] == EMIT_LEAVES:
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
        progress = descend(states, pose, at_once, ready, top, stack_inout, faces_inout)
        top = wp.int32(progress[0])
        compared += progress[2]
        for i in range(wp.int32(progress[1])):
            found_out[found] = faces_inout[i]
            found += 1
    count_out[0] = wp.int64(found)
    count_out[1] = compared


def traverse(kernel, scalars, states, poses, buffers, room):
    found = wp.empty(room, dtype=wp.int64, device=CPU)
    counts = wp.zeros(2, dtype=wp.int64, device=CPU)
    wp.launch(kernel, dim=1, inputs=[*scalars, states, poses, *buffers, found, counts], device=CPU)
    count, compared = counts.numpy()
    return np.sort(found.numpy()[:count]), int(compared)


def filled(count):
    return wp.full(count, UNTOUCHED, dtype=wp.int64, device=CPU)


@pytest.mark.parametrize("names", [("torus", "torus"), ("soup", "torus"), ("torus", "soup")], ids="-".join)
def test_descends_as_node_pair_tests_do(names):
    """The same pairs of boxes and faces, whatever is taken at once, in any order and at any level of detail."""
    a, b = (sample(name) for name in names)
    for lods in ((a.lod_max, b.lod_max), (a.lod_for(fraction=0.3), b.lod_for(fraction=0.1)), (0, b.lod_max)):
        pose_a, pose_b = contact_poses(np.random.default_rng(7), a, lods[0], b, lods[1])
        scene = ab.Scene(CPU)
        scene.add(a, pose_a, lod=lods[0])
        scene.add(b, pose_b, lod=lods[1])
        query = ab.Query(scene, "faces", pairs=[(0, 1)])
        query.launch()
        states = query.arrays[1].pool
        plain, compared = traverse(compare_all_kernel, [], states, query.pair_poses, [filled(4096)], 10**6)
        assert compared == query.hits.node_tests.numpy()[0] and len(plain) == query.hits.triangle_tests.numpy()[0]
        assert len(plain) > 0
        for at_once in (1, 2, 7, ITEMS_AT_ONCE):
            for ready in (1, WAITING_LENGTH - 4 * ITEMS_AT_ONCE - 4):
                stack, faces = filled(CPU_STACK_LENGTH + 1), filled(WAITING_LENGTH + 1)
                found, visited = traverse(
                    descend_kernel, [at_once, ready, 1], states, query.pair_poses, [stack, faces], 10**6
                )
                np.testing.assert_array_equal(found, plain)
                assert visited == compared


def test_descends_in_little_room():
    """A stack that starts full is worked off one item at a time, and nothing is written behind it."""
    model = sample("torus")
    scene = ab.Scene(CPU)
    for _ in range(2):
        scene.add(model, lod=model.lod_for(fraction=0.2))
    query = ab.Query(scene, "faces", pairs=[(0, 1)])
    query.launch()
    states = query.arrays[1].pool
    plain, compared = traverse(compare_all_kernel, [], states, query.pair_poses, [filled(4096)], 10**6)
    times = CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH
    stack, faces = filled(CPU_STACK_LENGTH + 64), filled(WAITING_LENGTH + 64)
    buffers, room = [stack, faces], times * len(plain)
    found, visited = traverse(descend_kernel, [ITEMS_AT_ONCE, 100, times], states, query.pair_poses, buffers, room)
    np.testing.assert_array_equal(found, np.repeat(plain, times))
    assert visited == times * compared
    assert (stack.numpy()[CPU_STACK_LENGTH:] == UNTOUCHED).all() and stack.numpy()[times] != UNTOUCHED
    assert (faces.numpy()[WAITING_LENGTH:] == UNTOUCHED).all()


@wp.kernel
def take_slots_kernel(count: wp.int32, total_inout: wp.array(dtype=wp.int32), slot_out: wp.array(dtype=wp.int32)):
    slot_out[wp.tid()] = take_slots(total_inout, count)


def test_slots_follow_one_another(device):
    total = wp.zeros(1, dtype=wp.int32, device=device)
    slots = wp.empty(100, dtype=wp.int32, device=device)
    wp.launch(take_slots_kernel, dim=100, inputs=[3, total, slots], device=device)
    assert (np.sort(slots.numpy()) == 3 * np.arange(100)).all() and total.numpy()[0] == 300
