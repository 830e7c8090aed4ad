"""The vector instructions of the CPU beside the plain functions that every device runs, number by number."""

import numpy as np
import pytest
import warp as wp
from samples import contact_poses, sample

import warp_abtree as ab
from warp_abtree.kernels.faces import screen_faces
from warp_abtree.kernels.pools import ModelPool, StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.predicates import EXACT, FLOAT32, UNSURE
from warp_abtree.kernels.screen import SCREEN_UNIT
from warp_abtree.kernels.traverse import WAITING_ROOM, first_item
from warp_abtree.kernels.vector import (
    ITEMS_AT_ONCE,
    ROOM_FOR_ONE,
    STACK_ROOM,
    descend,
    screen_waiting,
    single_node,
    take_slots,
)
from warp_abtree.kernels.visit import visit_item
from warp_abtree.kernels.warps import item_first, item_second, pack_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CPU = "cpu"
UNTOUCHED = -77


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
    meet_out[i] = screen_faces(mode, models, states, pose, item_first(faces[i]), item_second(faces[i]))


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
    counts = screen_waiting(models, states, pose, error, unit, first_ends, faces_inout.shape[0], faces_inout, open_out)
    for i in range(3):
        count_out[i] = counts[i]


def near_points(kind, rng, count):
    """Return float32 (count, 4), on which signs are sure, zero, lost in rounding, or no numbers."""
    points = rng.uniform(-1, 1, (count, 3))
    if kind == "lattice":
        points = rng.integers(-1, 2, (count, 3)).astype(float)
    elif kind == "flat":
        points[:, 2] = 1e-7 * points[:, 2]
    elif kind == "wild":
        points = points * 10.0 ** rng.integers(-44, 39, (count, 1))
        points[rng.random(count) < 0.02] = np.inf
        points[rng.random(count) < 0.02] = np.nan
    return np.pad(points, ((0, 0), (0, 1))).astype(np.float32)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", ["random", "lattice", "flat", "wild"])
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
            faces = wp.array(asked, dtype=wp.int64, device=CPU)
            left = wp.full(ask_count, UNTOUCHED, dtype=wp.int64, device=CPU)
            counts = wp.zeros(3, dtype=wp.int64, device=CPU)
            unit = 0.0 if error == 0.0 else float(SCREEN_UNIT)
            inputs = [first_ends, error, unit, models, states, *placed, face_count, faces, left, counts]
            wp.launch(screen_all_kernel, dim=1, inputs=inputs, device=CPU)
            met, unsure, tested = counts.numpy()
            hit = np.flatnonzero(meet == 1)
            ends = first_ends and len(hit) > 0
            assert tested == (min(ask_count, 16 * (hit[0] // 16 + 1)) if ends else ask_count)
            np.testing.assert_array_equal(faces.numpy()[:met], asked[:tested][meet[:tested] == 1])
            np.testing.assert_array_equal(left.numpy()[:unsure], asked[:tested][meet[:tested] == int(UNSURE)])
            assert (left.numpy()[unsure:] == UNTOUCHED).all()
        seen.append(np.bincount(meet, minlength=int(UNSURE) + 1) > 0)
    assert seen[1][[0, 1, int(UNSURE)]].all() or kind in ("flat", "wild")
    assert np.isin(meet, [0, int(UNSURE)]).all(), "no sign is sure where the bound is no number"


# --- the traversal ---------------------------------------------------------------------------------------------------


@wp.kernel
def visit_all_kernel(
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    stack_inout: wp.array(dtype=wp.int64),
    found_out: wp.array(dtype=wp.int64),
    count_out: wp.array(dtype=wp.int64),
):
    """Traverse pair 0 by `visit_item`, one item at a time."""
    pose = pair_poses[0]
    stack_inout[0] = first_item(states, pose)
    top, found, compared = wp.int32(1), wp.int32(0), wp.int32(0)
    while top > 0:
        top -= 1
        items, mask, tests = visit_item(states, pose, stack_inout[top])
        compared += tests
        for k in range(4):
            if (mask >> k) & 1 != 0:
                stack_inout[top] = items[k]
                top += 1
            if (mask >> (k + 4)) & 1 != 0:
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
        stack_inout[i] = pack_item(single_node(item_first(root)), single_node(item_second(root)))
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
def test_descends_as_visits_do(names):
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
        plain, compared = traverse(visit_all_kernel, [], states, query.pair_poses, [filled(4096)], 10**6)
        assert compared == query.hits.node_tests.numpy()[0] and len(plain) == query.hits.triangle_tests.numpy()[0]
        assert len(plain) > 0
        for at_once in (1, 2, 7, ITEMS_AT_ONCE):
            for ready in (1, WAITING_ROOM - 4 * ITEMS_AT_ONCE - 4):
                stack, faces = filled(STACK_ROOM + 1), filled(WAITING_ROOM + 1)
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
    plain, compared = traverse(visit_all_kernel, [], states, query.pair_poses, [filled(4096)], 10**6)
    times = STACK_ROOM - ROOM_FOR_ONE
    stack, faces = filled(STACK_ROOM + 64), filled(WAITING_ROOM + 64)
    buffers, room = [stack, faces], times * len(plain)
    found, visited = traverse(descend_kernel, [ITEMS_AT_ONCE, 100, times], states, query.pair_poses, buffers, room)
    np.testing.assert_array_equal(found, np.repeat(plain, times))
    assert visited == times * compared
    assert (stack.numpy()[STACK_ROOM:] == UNTOUCHED).all() and stack.numpy()[times] != UNTOUCHED
    assert (faces.numpy()[WAITING_ROOM:] == UNTOUCHED).all()


@wp.kernel
def take_slots_kernel(count: wp.int32, total_inout: wp.array(dtype=wp.int32), slot_out: wp.array(dtype=wp.int32)):
    slot_out[wp.tid()] = take_slots(total_inout, count)


def test_slots_follow_one_another(device):
    total = wp.zeros(1, dtype=wp.int32, device=device)
    slots = wp.empty(100, dtype=wp.int32, device=device)
    wp.launch(take_slots_kernel, dim=100, inputs=[3, total, slots], device=device)
    assert (np.sort(slots.numpy()) == 3 * np.arange(100)).all() and total.numpy()[0] == 300
