"""Edges of robots alone, in batches and against dense samples; the reach of a part against longer numbers."""

import copy
from functools import cache
from itertools import product

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.robots import AROUND, described_arm, described_chain, random_configurations
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree.interop.robot import check, robot
from warp_abtree.interop.robot.description import Part, RobotFrame
from warp_abtree.kernels.robot import forward, link_pairs
from warp_abtree.model.mesh import mesh_from_arrays

WALL = ab.Model.load(trimesh.creation.box((0.1, 1, 1)))
X, Y, Z, HERE = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)
CUBE = trimesh.creation.box((0.1, 0.1, 0.1))


@pytest.fixture(scope="module")
def arms():
    """Return the arm of a device, made once."""
    return cache(lambda device: ab.Robot(described_arm(), device, mounted=["base"]))


def random_edges(count, seed, part=0.15):
    starts, others = random_configurations(count, seed=seed), random_configurations(count, seed=(seed, 1))
    return starts, starts + part * (others - starts)


def meets(arm, around, starts, ends, times):
    rows = starts[:, None] + times[..., None] * (ends - starts)[:, None]
    return arm.check(rows.reshape(-1, starts.shape[1]), around, limits=False).reshape(times.shape)


def check_never_late(arm, around, starts, ends, rows, tolerance):
    """Sample edges before their times: within the tolerance, ever nearer, and all the way."""
    time = rows["time"][:, None]
    back = tolerance * np.append(2.0 ** -np.arange(1, 30), np.linspace(0.03, 1, 20))
    times = np.concatenate([time - back, time * np.linspace(0, 1 - 2.0**-40, 60)], axis=1)
    hit = meets(arm, around, starts, ends, np.maximum(times, 0.0))
    assert not hit[(times >= 0) & (times < time)].any()
    assert not (rows["clear"] & rows["undecided"]).any() and (rows["time"][rows["clear"]] == 1).all()


# The fixtures are a name and what makes arms: the same for all examples.
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.9, 0.1, 1e-2, 1e-3, 2.0**-20]), st.floats(0.01, 0.4))
def test_an_edge_alone_and_in_any_batch_has_the_same_bits(arms, device, seed, tolerance, part):
    arm = arms(device)
    starts, ends = random_edges(8, seed, part)
    # One joint moves; none does; the same again, and back.
    ends[0, 1:], ends[1] = starts[0, 1:], starts[1]
    starts[3:5], ends[3:5] = (starts[2], ends[2]), (ends[2], starts[2])
    alone = np.concatenate([arm.check_edges(a[None], b[None], AROUND, tolerance) for a, b in zip(starts, ends)])
    order = np.random.default_rng(seed).permutation(8)
    batch = arm.check_edges(starts[order], ends[order], AROUND, tolerance)
    assert batch.tobytes() == alone[order].tobytes()
    check_never_late(arm, AROUND, starts, ends, alone, tolerance)


@pytest.mark.parametrize("padding", [{}, {"upper": 0.01, "fore": 0.02, "left": 0.03}], ids=["bare", "padded"])
def test_times_are_never_late_and_early_by_the_tolerance_at_most(arms, device, monkeypatch, padding):
    arm, (starts, ends) = copy.copy(arms(device)), random_edges(40, 7)
    arm.link_padding = padding
    rows = arm.check_edges(starts, ends, AROUND, tolerance=2.0**-10)
    met = ~rows["clear"]
    assert 10 < met.sum() < 36 and 3 < (rows["time"] == 0).sum() and not rows["undecided"].any()
    check_never_late(arm, AROUND, starts, ends, rows, 2.0**-10)
    # What decides an edge is met in the middle of a stretch: a multiple of a small power of two.
    after = np.minimum(rows["time"][:, None] + np.arange(17) * 2.0**-14, 1.0)
    np.testing.assert_array_equal(meets(arm, AROUND, starts, ends, after).any(1), met)
    monkeypatch.setattr(robot, "ROOMS", {"cpu": (7,), "cuda": (7,)})
    monkeypatch.setattr(check, "EDGES_AT_ONCE", 3)
    assert arm.check_edges(starts, ends, AROUND, tolerance=2.0**-10).tobytes() == rows.tobytes()


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 1e-2])
def test_an_edge_beside_one_that_slides_along_a_wall(device, tolerance):
    car = ab.Robot(described_chain(CUBE, ("prismatic", X, HERE, 1.0), ("prismatic", Y, HERE, 1.0)), device)
    wall = [(WALL, (0.71, 0, 0, 0, 0, 0, 1))]  # touched from x = 0.61 on
    run, slide, near = ([0, 0], [1, 0]), ([0.6, -0.4], [0.6, 0.4]), ([0.61 - 1e-8, -0.4], [0.61 - 1e-8, 0.4])
    for edges in ([run, slide], [near, run], [slide, near, run, run]):
        starts, ends = np.array(edges, np.float64).transpose(1, 0, 2)
        alone = [car.check_edges(a[None], b[None], wall, tolerance)[0] for a, b in zip(starts, ends)]
        rows = car.check_edges(starts, ends, wall, tolerance)
        assert rows.tolist() == [row.item() for row in alone]
        for edge, row in zip(edges, rows):
            least, most = {id(run): (0.61 - tolerance, 0.61), id(slide): (1, 1), id(near): (0, 0)}[id(edge)]
            assert least <= row["time"] <= most
            assert (row["clear"], row["undecided"]) == (edge is slide, edge is near)


def test_edges_that_rest_are_as_they_start(device):
    """Also where rounding could move parts by more than what is between them."""
    car = ab.Robot(described_chain(CUBE, ("prismatic", X, HERE, 1.0)), device)
    wall = [(WALL, (0.71, 0, 0, 0, 0, 0, 1))]
    rest = np.nextafter(0.61, 0) * np.ones((3, 1)) - [[0.0], [1e-15], [-1e-12]]
    rows = car.check_edges(rest, rest, wall)
    np.testing.assert_array_equal(rows["clear"], ~car.check(rest, wall))
    assert not rows["undecided"].any() and (rows["time"] == rows["clear"]).all() and not rows["clear"][2]


@pytest.mark.parametrize("scale", [1.0, -1.0, -0.5])
@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_a_joint_that_mimics_backwards_meets_a_thin_wall(device, kind, scale):
    """The cube slides along y, or turns around z at a distance of 1, to a wall before y = 0.3707."""
    mesh = CUBE.copy()
    mesh.apply_translation((1, 0, 0))
    joint = (kind, Y if kind == "prismatic" else Z, HERE, scale)
    finger = ab.Robot(described_chain(mesh, joint), device)
    wall = [(ab.Model.load(trimesh.creation.box((1, 1e-4, 1))), (1, 0.3707, 0, 0, 0, 0, 1))]
    starts, ends = np.zeros((1, 1)), np.full((1, 1), 1 / scale)
    rows = finger.check_edges(starts, ends, wall)
    check_never_late(finger, wall, starts, ends, rows, 1e-3)
    # The corner that meets the wall first is at (1.05, 0.05) before the cube turns.
    height = 0.3707 - 5e-5
    angle = np.arcsin(height / np.hypot(1.05, 0.05)) - np.arctan2(0.05, 1.05)
    contact = height - 0.05 if kind == "prismatic" else angle
    assert not rows["clear"][0] and contact - 1e-3 <= rows["time"][0] <= contact


@pytest.mark.parametrize("turned", [False, True])
def test_parts_of_a_robot_meet_each_other_whichever_moves(device, turned):
    """A cube slides along x on two joints; thin plates are on the base, at x = 2, and on a slide of their own."""
    made = described_chain(CUBE, ("prismatic", X, HERE, 1.0), ("prismatic", Y, HERE, 1.0))
    made.frames.append(RobotFrame(0, np.eye(4), "prismatic", X, "plate"))
    made.joints["plate"], made.links["plate"] = (-np.inf, np.inf), 3
    for link, x in ((3, 0.0), (0, 2.0)):
        plate = trimesh.creation.box((1e-4, 1, 1), trimesh.transformations.translation_matrix((x, 0, 0)))
        made.parts.append(Part(link, mesh_from_arrays(plate.vertices, plate.faces, name=f"plate {link}")))
    slides = ab.Robot(made, device)
    assert sorted(slides.pairs.tolist()) == [[0, 1], [0, 2]]
    slides.pairs = slides.pairs[:, ::-1] if turned else slides.pairs
    near = 0.05 + 5e-5  # middles of the cube and a plate that touch
    edges = {  # by the time of contact
        0.3707 - near: ((0, 0, 0.3707), (1, 0, 0.3707)),
        1 - near: ((0, 0, 1), (0, 0, 0)),
        0.37 - near: ((0, 0, 0.37), (0.5, 0, -0.13)),
        0.5 - near: ((1.5, 0, -3), (2.5, 0, -3)),
        np.inf: ((0, 0, 0.37), (1, 0, 1.37)),
    }
    starts, ends = np.array(list(edges.values()), np.float64).transpose(1, 0, 2)
    rows = slides.check_edges(starts, ends)
    check_never_late(slides, None, starts, ends, rows, 1e-3)
    contact = np.array(list(edges))
    np.testing.assert_array_equal(rows["clear"], np.isinf(contact))
    assert (rows["time"] <= contact).all() and (rows["time"] >= np.minimum(contact, 1) - 1e-3 - 1e-12).all()


def test_edges_that_slide_are_undecided(arms, device, monkeypatch):
    arm = arms(device)
    monkeypatch.setattr(check, "STRETCHES_MAX", 64)
    # The ring turns in its own plane, so near a plate that no stretch is proved free.
    plate = [(ab.Model.load(trimesh.creation.box((3, 3, 0.02))), (0, 0, 0.36 - 0.01 - 1e-7, 0, 0, 0, 1))]
    ends = np.array([[0.0, 0, 0.05, 0], [3.0, 0, 0.05, 0]])
    assert not arm.check(ends, plate).any()
    row = arm.check_edges(ends[:1], ends[1:], plate)[0]
    assert row["undecided"] and not row["clear"] and row["time"] == 0


def needle(length=1.0):
    """Return a mesh along x, from the origin on."""
    mesh = trimesh.creation.box((length, 1e-6, 1e-6))
    mesh.apply_translation((length / 2, 0, 0))
    return mesh


@wp.kernel
def reach_kernel(
    chain: forward.Chain,
    frames: forward.Frames,
    parts: link_pairs.Parts,
    chunk: link_pairs.Chunk,
    reach_out: wp.array(dtype=wp.float64),
):
    i = wp.tid()
    reach_out[i] = link_pairs.part_reach(chain, frames, parts, chunk, i, 0, -1)


def find_reach(description, device, middle, half, size):
    """Return the reach of the only part at a configuration, and where its vertices stand there as computed."""
    robot = ab.Robot(description, device)
    links = check.RobotQuery(robot, None, "within", 1)
    for target, values in ((links.configurations, middle), (links.chunk.half, half), (links.chunk.size, size)):
        target.assign(np.array(values, np.float64)[None])
    links.place()
    reach = wp.zeros(1, dtype=wp.float64, device=device)
    inputs = [links.chain, links.frames, links.parts, links.chunk, reach]
    wp.launch(reach_kernel, 1, inputs, device=device)
    placed = links.frames.rotation, links.frames.position
    rotation, position = (array.numpy()[0, -1].astype(np.longdouble) for array in placed)
    return reach.numpy()[0], description.parts[0].mesh.vertices @ rotation.T + position


def place_exactly(description, row):
    """Return where the vertices of the only part are, in extended precision."""
    values = dict(zip(description.joints, np.asarray(row, np.longdouble)))
    rotation, position = np.eye(3, dtype=np.longdouble), np.zeros(3, np.longdouble)
    for frame in description.frames:
        origin, axis = frame.origin.astype(np.longdouble), np.array(frame.axis, np.longdouble)
        position = position + rotation @ origin[:3, 3]
        rotation = rotation @ origin[:3, :3]
        value = 0 if frame.joint is None else frame.scale * values[frame.joint] + np.longdouble(frame.offset)
        if frame.kind == "revolute":
            cross = np.cross(np.eye(3), axis)
            rotation = rotation @ (np.eye(3) + np.sin(value) * cross + (1 - np.cos(value)) * (cross @ cross))
        elif frame.kind == "prismatic":
            position = position + rotation @ (axis * value)
    return description.parts[0].mesh.vertices @ rotation.T + position


def farthest(description, placed, rows):
    """Return how far any vertex is from where it was placed, at the farthest of configurations."""
    return max(np.linalg.norm((place_exactly(description, row) - placed).astype(float), axis=1).max() for row in rows)


# The fixture is the name of a device: the same for all examples.
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1))
def test_no_point_leaves_its_reach(device, seed):
    rng = np.random.default_rng(seed)
    joints = []
    for axis in Rotation.random(rng.integers(1, 5), rng=rng).as_matrix()[:, 0]:
        kind = rng.choice(["revolute", "revolute", "prismatic"])
        joints.append((kind, tuple(axis), rng.normal(size=3), rng.choice([1.0, -1.0, 2.0, -0.5])))
    description = described_chain(needle(), *joints)
    middle, half = rng.uniform(-3, 3, len(joints)), 10 ** rng.uniform(-3, 0.3, len(joints))
    reach, placed = find_reach(description, device, middle, half, np.abs(middle) + half)
    rows = middle + half * np.array([*product((-1, 0, 1), repeat=len(joints)), *rng.uniform(-1, 1, (20, len(joints)))])
    assert farthest(description, placed, rows) <= reach


@pytest.mark.parametrize("scales", [(1, 1, 1, 1), (-1, 1, -0.5, 2)])
@pytest.mark.parametrize("moved", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1, 1, 1, 1)])
def test_the_reach_of_a_straight_arm_is_what_its_joints_do(device, scales, moved):
    """Turns of a straight arm and a slide across it add up: no term can be less, and none is more than it moves."""
    kinds = ("revolute", "prismatic", "revolute", "revolute")
    axes, places = (Z, Y, Z, Z), (HERE, X, X, X)
    description = described_chain(needle(), *zip(kinds, axes, places, scales))
    half = 0.01 * np.array(moved) / scales
    reach, placed = find_reach(description, device, np.zeros(4), np.abs(half), np.abs(half))
    assert 0.999 * reach <= farthest(description, placed, [half]) <= reach


FAR, OUT, BACK = (("fixed", Z, place, 1.0) for place in ((1e3, 0, 0), (1000.1, 0, 0), (-1000.0, 0.03, 0)))
ROUNDED = {
    # Values near 2^20 round by 2^-34, which moves a part a thousand units from the axis.
    "values": ([("revolute", Z, HERE, 1.0), FAR], [2.0**20 - 1], 0.0, 1.0, 0.0),
    # So do sums with an offset of the size.
    "offsets": ([("revolute", Z, HERE, 1.0), FAR], np.linspace(0.1, 0.9, 9), 0.0, 1.0, 2.0**20 - 1),
    # On a way of a thousand units out and back to the axis poses round by more than the angle.
    "poses": ([("revolute", Z, HERE, 1.0), OUT, BACK], np.linspace(-1, 1, 20), 0.0, 1.0, 0.0),
    # A slide of a thousand units along an axis that the transforms before it stretch.
    "transforms": ([*20 * [("fixed", Z, HERE, 1.0)], ("prismatic", X, HERE, 1.0)], [0.0], 1e3, 1 + 4.9e-13, 0.0),
}


@pytest.mark.parametrize("name", ROUNDED)
def test_the_reach_covers_rounding(device, name):
    joints, middles, half, stretch, offset = ROUNDED[name]
    description = described_chain(needle(1e-3), *joints)
    for frame in description.frames:
        frame.origin[:3, :3] *= stretch
    description.frames[1].offset = offset
    for middle in middles:
        reach, placed = find_reach(description, device, [middle], [half], [abs(middle) + half])
        rows = [[middle + half], [np.nextafter(middle, np.inf) + half]]
        assert farthest(description, placed, rows) <= reach <= half + 1e-5
