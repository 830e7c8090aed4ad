"""The reach of a robot's part covers where its points may be, by poses in extended precision, and little more."""

from itertools import product

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.robots import described_chain
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree.interop.robot.check import make_link_request
from warp_abtree.interop.robot.link_query import LinkHits
from warp_abtree.interop.robot.surroundings import RobotBatch
from warp_abtree.kernels.robot import forward, link_pairs

X, Y, Z, HERE = (1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0, 0, 0)


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
    batch = RobotBatch(None, robot.models, 1, robot.device)
    links = LinkHits(batch.batch, make_link_request(robot, batch, 1), 1, True)
    for target, values in ((links.configurations, middle), (links.chunk.half, half), (links.chunk.size, size)):
        target.assign(np.array(values, np.float64)[None])
    links.place()
    reach = wp.zeros(1, dtype=wp.float64, device=device)
    inputs = [links.request.chain, links.frames, links.request.parts, links.chunk, reach]
    wp.launch(reach_kernel, 1, inputs, device=device)
    rotation, position = (
        a.numpy()[0, -1].astype(np.longdouble) for a in (links.frames.rotation, links.frames.position)
    )
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
