"""Mean slabs of nodes and balls about their boxes' centres hold the faces below, and are no larger than need be."""

import numpy as np
import pytest
from helpers.questions import scene_of
from helpers.samples import STILL, sample

import warp_abtree as ab
from warp_abtree.kernels.distance.frame import PAIRS_LEAST
from warp_abtree.kernels.search.mean_slabs import USES_MIN


def read_slabs(device, model, lod):
    """Return a state of a model, and the records of its nodes: normal, ends, weight and radius, float32 (nodes, 7)."""
    scene = scene_of(device, [(model, lod, STILL, sample("box"), None, STILL)])
    query = ab.DistanceQuery(scene, [(0, 1)] * max(int(PAIRS_LEAST), int(USES_MIN)))
    for _ in range(2):
        query.launch()
    slabs = query.stages[-1].slabs
    assert slabs.made.numpy()[0, 0] == lod
    state = scene.tree_state(0)
    records = slabs.record.numpy().reshape(-1, 8)[: len(state.status), :7]  # of inactive nodes no numbers
    return state, records


@pytest.mark.parametrize("name", ["torus", "soup", "crumbs", "lattice soup"])
@pytest.mark.parametrize("part", [1.0, 0.6, 0.1])
def test_slabs_and_balls_hold_their_faces(device, regime, name, part):
    """Of every active node; a leaf's ball reaches its farthest corner, another's no farther than its box does."""
    model = sample(name)
    lod = round(part * model.lod_max)
    state, records = read_slabs(device, model, lod)
    vertices, faces, ids = model.mesh_at(lod)
    near = vertices - model.centre
    rounding = 2.0**-22 * np.abs(near).max()  # of vertices to float32, and of ends
    leaves, corners, checked = state.face_node[ids], near[faces], [0, 0]
    for node in np.flatnonzero(state.status):
        below = corners[leaves >> np.maximum(depth_of(leaves) - depth_of(node), 0) == node]
        assert len(below)
        normal, (low, high, _, radius) = np.split(records[node].astype(float), [3])
        along, middle = below @ normal, (state.lower[node] + state.upper[node]) / 2 - model.centre
        reach = np.linalg.norm(below - middle, axis=2).max()
        assert abs(np.linalg.norm(normal) - 1) < 1e-6 or not normal.any()
        assert low <= along.min() + rounding and along.max() - rounding <= high
        assert reach - rounding <= radius <= np.linalg.norm(state.upper[node] - state.lower[node]) / 2 + rounding
        if len(below) == 1:
            assert radius <= reach + rounding and high - low <= np.ptp(along) + 2 * rounding
        half = np.linalg.norm(state.upper[node] - state.lower[node]) / 2
        checked[int(len(below) > 1 and radius < 0.98 * half)] += 1
    assert sum(checked) > 8 and (checked[1] > 0 or name != "soup")


def depth_of(node):
    """Return the level of heap indices, the root's 0."""
    return np.frexp(np.asarray(node, float))[1] - 1
