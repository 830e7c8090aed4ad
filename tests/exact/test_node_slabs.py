"""Slabs of nodes of few faces, which warps compare: they hold their faces, and prune no pair that touches."""

from fractions import Fraction

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.nested import shells, touching_soups
from helpers.questions import GpuQuery, launch
from helpers.samples import sample
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import SLAB_DEPTH, PairBatch
from warp_abtree.kernels.search.item import pack_item
from warp_abtree.kernels.search.slab_overlap import DIRECTION_LENGTH, slabs_overlap
from warp_abtree.testing import regime

wp.set_module_options(native.options())


def read_slabs(pool, model, entry=0):
    """Return directions, sums and sizes of the nodes of a scene's first model, and the first that has a slab.

    Args:
        entry: 0 for the finest LOD, or how many models there are.
    """
    start = 0 if entry == 0 else len(pool.node_slab) // 2
    records = pool.node_slab.numpy()[start : start + model.tree.node_count]
    low, high = records[:, 0].view(np.int32), records[:, 1].view(np.int32)
    directions = np.stack([low & 0xFFFF, (low >> 16) & 0xFFFF, high], 1) - int(DIRECTION_LENGTH)
    return directions, records[:, 2], records[:, 3], int(pool.slab_first.numpy()[entry])


def check_slabs(slabs, model, corner, faces):
    """Check that slabs of all nodes above hold the corners of faces, (n_f, 3, 3), by exact extents along directions."""
    directions, sums, sizes, first = slabs
    leaf_node, reach = model.tree.leaf_node, np.abs(corner[faces]).max()
    for face in faces[:200]:
        node = int(leaf_node[face])
        while node >= first:
            n = directions[node]
            assert abs(np.linalg.norm(n) / int(DIRECTION_LENGTH) - 1) < 1e-3
            for p in corner[face]:
                along = sum(2 * Fraction(float(x)) * int(k) for x, k in zip(p, n))
                rounding = Fraction(float(reach)) * 2**-34  # of float64, which the margin covers
                assert abs(along - Fraction(float(sums[node]))) <= Fraction(float(sizes[node])) + rounding
            node >>= 1
    return np.median(sizes[leaf_node[faces[:200]]]) / (int(DIRECTION_LENGTH) * reach)


@pytest.mark.parametrize("name", ["torus", "soup", "crumbs", "box"])
def test_slabs_hold_their_faces(device, name):
    """Of every node the exact extent along its direction, in fractions; and nodes of one face are as thin as it is."""
    model = sample(name)
    query = GpuQuery(scene_with(device, model, model), "any", pairs=[(0, 1)])
    slabs = read_slabs(query.batch.models.pool, model)
    assert slabs[3] == 1 << max(0, model.tree.depth - int(SLAB_DEPTH))
    corner = (model.progressive.vertex_pos - model.centre)[model.progressive.face_vertex]
    used = np.flatnonzero(model.tree.node_face[model.tree.leaf_node] >= 0)
    assert check_slabs(slabs, model, corner, used) < 1e-3


def search_near(scene, gap):
    """Return the bytes of the contacts of the first two objects within a gap by warps, face pairs tested, and the
    models' pool."""
    query = ab.ContactQuery(scene, [(0, 1)], gap=gap)
    for _ in range(3):
        found = query.run()
    return found.contacts.tobytes(), int(found.triangle_tests[0]), query.batch.models.pool


def test_slabs_of_a_lod_that_stays(device):
    """They hold the faces as they are there, leave all that is near, and serve no other LOD."""
    gap, mesh = 0.01, trimesh.creation.torus(1.0, 0.4, 120, 60)
    models = shells(np.random.default_rng(4), gap, mesh)
    fine, coarse = ([model.lod_for(fraction=part) for model in models] for part in (0.8, 0.6))
    scene, contacts = scene_with(device, *models), []
    with regime(warps=True):
        for lods in (fine, coarse):
            scene.set_lods(lods)
            near, tested, pool = search_near(scene, gap)
            assert pool.slab_lod.numpy().tolist() == lods and len(near) > 0
            with regime(slabs=False):
                plain = scene_with(device, *models)
                plain.set_lods(lods)
                expected, plain_tests, _ = search_near(plain, gap)
            assert near == expected and tested < plain_tests
            contacts.append(near)
            progressive = models[0].progressive
            active = np.flatnonzero(progressive.face_split <= lods[0])
            moved = progressive.vertex_pos[progressive.active_vertices(lods[0])[progressive.face_vertex]]
            check_slabs(read_slabs(pool, models[0], 2), models[0], moved - models[0].centre, active)
        query = ab.ContactQuery(scene, [(0, 1)], ab.Buffers(hits=2**18, uncertain=2**20), gap=gap)
        scene.set_lods(fine)
        query.launch()
        assert pool.slab_lod.numpy().tolist() == coarse, "the first search at an LOD comes before its slabs"
        assert query.result().contacts.tobytes() == contacts[0]


def test_slabs_at_the_coarsest_lod_and_of_removed_objects(device):
    """Slabs begin at most three levels above those of the finest LOD; who is left tells the LOD."""
    model = sample("torus")
    scene = scene_with(device, model, model, model)
    with regime(warps=True):
        scene.set_lods([0, 0, model.lod_max])
        pool = search_near(scene, 0.02)[2]
        assert pool.slab_lod.numpy().tolist() == [0]
        assert pool.slab_first.numpy().tolist() == [1 << model.tree.depth - k for k in (SLAB_DEPTH, SLAB_DEPTH + 3)]
        scene.remove([0, 1])
        scene.add(model, lod=3)
        scene.add(model, lod=3)
        query = ab.ContactQuery(scene, scene.broad_phase()[-1:], gap=0.02)
        for _ in range(3):
            query.run()
        assert query.batch.models.pool.slab_lod.numpy()[0] == 3


@wp.kernel
def compare_slabs_kernel(
    margin_factor: wp.float32,
    within: wp.float64,
    trees: Trees,
    batch: PairBatch,
    nodes: wp.array(dtype=wp.vec2i),
    overlap_out: wp.array(dtype=wp.int32),
):
    """Note which nodes slabs do not separate."""
    i = wp.tid()
    pose = batch.poses[0]
    pose.margin = wp.float32(wp.float64(pose.margin * margin_factor) + wp.float64(1.0000003) * within)
    pose.within = within
    item = pack_item(nodes[i][0], nodes[i][1])
    overlap_out[i] = wp.where(slabs_overlap(trees, pose, item), 1, 0)


def ask(device, models, pose):
    """Return a query, which has been launched, of two models, the second at a pose."""
    query = GpuQuery(scene_with(device, models[0], (models[1], pose)), "any", pairs=[(0, 1)])
    query.launch()
    return query


def count_lost(query, models, levels, margin_factor, within=0.0):
    """Return how many nodes so far above faces that meet slabs separate."""
    nodes = np.stack([model.tree.leaf_node for model in models], 1) >> levels
    inputs = margin_factor, within, query.batch.trees, query.pair_batch, nodes
    return (launch(compare_slabs_kernel, query.device, len(nodes), *inputs) == 0).sum()


@pytest.mark.parametrize("reach_a, reach_b", [(1e-3, 1e3), (1e3, 1e-3), (1e-3, 1e-3)])
def test_margin_covers_rounding(device, reach_a, reach_b):
    """Faces that touch in a point survive, as do the nodes above; without the margin some do not."""
    rng, lost = np.random.default_rng(8), 0
    for _ in range(10):
        models, pose = touching_soups(rng, 128, reach_a, reach_b)
        query = ask(device, models, pose)
        for levels in range(3):
            assert count_lost(query, models, levels, 1.0) == 0
        lost += count_lost(query, models, 0, 0.0)
    assert lost > 100


@pytest.mark.parametrize("gap", [1e-6, 1.0, 1e30])
def test_slabs_keep_what_is_nearer_than_a_gap(device, gap):
    """Faces in parallel planes a gap apart survive, as do the nodes above; within a little less most do not."""
    rng = np.random.default_rng(9)
    models, pose = touching_soups(rng, 128, 1.0, 1.0, gap if gap < 1e9 else 0.0)
    query = ask(device, models, pose)
    for levels in range(3):
        assert count_lost(query, models, levels, 1.0, gap) == 0
        assert count_lost(query, models, levels, 1.0, 1e300 * gap) == 0
    if 1e-3 < gap < 1e9:
        assert count_lost(query, models, 0, 1.0, 0.95 * gap) > 64
