"""Batched traversal: every intersecting face pair, against exact brute force and an independent library."""

import copy
import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from conftest import ROOT, slow
from helpers.questions import GpuQuery, ask, in_a_row, launch, pairs_of, random_case, scene_of, sort_rows
from helpers.samples import REAL_MESHES, SHAPES, STILL, WARP_MESHES, contact_poses, random_poses, sample, true_faces
from helpers.scenes import scene_with
from oracles.peers import fcl_faces, judge
from oracles.triangle import into_frame_of_a

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SHAPE_PAIRS = [("capsule", "box"), ("crumbs", "crumbs"), ("soup", "ball"), ("soup", "lattice soup")]
SHAPE_PAIRS += [("grid", "torus"), ("twins", "twins"), ("two", "three")]
REAL_PAIRS = list(zip(REAL_MESHES, REAL_MESHES[1:] + REAL_MESHES[:1], strict=True))
BUNDLED_PAIRS = [("warp:bunny", "warp:bear"), ("warp:rocks", "fcl-env")]
BRUTE_FACES = 2500


@pytest.mark.parametrize("names", [*SHAPE_PAIRS, *slow(*REAL_PAIRS, *BUNDLED_PAIRS)], ids="-".join)
def test_faces_equal_brute_force(device, names):
    """Also of swapped pairs; the three outputs agree, and results are typed, shaped and sorted as promised."""
    rng, count = np.random.default_rng(1), 10 if names in SHAPE_PAIRS else 4
    cases = [random_case(rng, names, BRUTE_FACES) for _ in range(count)]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    result = scene.intersect(pairs, "faces")
    rows = np.concatenate([np.insert(true_faces(*case), 0, p, 1) for p, case in enumerate(cases)])
    np.testing.assert_array_equal(result.faces, rows)
    assert len(rows) > 0
    np.testing.assert_array_equal(scene.intersect(pairs[:, ::-1], "faces").faces, sort_rows(rows[:, [0, 2, 1]]))
    np.testing.assert_array_equal(result.pairs, pairs)
    assert (result.any.dtype, result.count.dtype.kind, result.faces.dtype) == (bool, "i", np.int32)
    np.testing.assert_array_equal(result.count, np.bincount(result.faces[:, 0], minlength=len(pairs)))
    np.testing.assert_array_equal(result.any, result.count > 0)
    counts, alone = scene.intersect(pairs, "count"), scene.intersect(pairs, "any")
    np.testing.assert_array_equal(counts.count, result.count)
    np.testing.assert_array_equal([counts.any, alone.any], [result.any] * 2)
    assert counts.faces is None and alone.faces is None and alone.count is None
    assert (alone.triangle_tests <= result.triangle_tests).all()


@pytest.mark.parametrize("names", [*SHAPE_PAIRS[:3], *slow(*REAL_PAIRS, WARP_MESHES[:2])], ids="-".join)
def test_agrees_with_fcl(device, names):
    """Any LOD up to the original; FCL's own mistakes are told apart by the exact test."""
    pytest.importorskip("fcl")
    rng, wrong = np.random.default_rng(3), 0
    cases = [random_case(rng, names, 10**6) for _ in range(3)]
    result = ask(device, cases)
    for p, (model_a, lod_a, pose_a, model_b, lod_b, pose_b) in enumerate(cases):
        (*mesh_a, ids_a), (*mesh_b, ids_b) = model_a.mesh_at(lod_a), model_b.mesh_at(lod_b)
        ours = result.faces[result.faces[:, 0] == p][:, 1:]
        rows = np.stack([np.searchsorted(ids_a, ours[:, 0]), np.searchsorted(ids_b, ours[:, 1])], 1)
        pair = (*mesh_a, *mesh_b, pose_a, pose_b)
        ours_wrong, theirs_wrong = judge(rows, fcl_faces(*pair), *pair)
        assert ours_wrong == []
        wrong += len(theirs_wrong)
    assert wrong <= 0.02 * len(result.faces) + 2
    assert len(result.faces) > 0


@wp.kernel
def pose_point_kernel(pair_poses: wp.array[PairPose], points: wp.array[wp.vec3d], moved_out: wp.array2d[wp.vec3d]):
    p, i = wp.tid()
    moved_out[p, i] = pose_point(pair_poses[p].rotation, pair_poses[p].translation, points[i])


def test_relative_poses_equal_the_definition(device):
    """Where B's vertices lie in A's frame, to the bit: every answer is defined on these coordinates."""
    rng = np.random.default_rng(10)
    poses = np.concatenate([random_poses(rng, 20, spread) for spread in (3.0, 1e-3, 1e7)])
    points = rng.normal(size=(50, 3)) * 2.0 ** rng.integers(-30, 5, (50, 3))
    points[:2] = (0, 0, 0), (2.0**-291, -(2.0**-300), 2.0**-290)
    poses[:2] = STILL
    scene = scene_with(device, *[(sample("box"), pose) for pose in poses])
    pairs = np.concatenate([np.arange(60).reshape(-1, 2), rng.permutation(60).reshape(-1, 2)])
    query = ab.Query(scene, "any", pairs=pairs, precision="exact")
    query.launch()
    moved = launch(pose_point_kernel, device, (60, 50), query.pair_poses, points)
    for (i, j), got in zip(pairs, moved, strict=True):
        np.testing.assert_array_equal(got, into_frame_of_a(points, poses[min(i, j)], poses[max(i, j)]))


# Degenerate contact. Coordinates are small multiples of a power of two, so that float64 decides exactly.


def rounded(name):
    """Return a model whose coordinates are whole multiples of 2^-12 of its extent."""
    model = sample(name)
    vertices, faces, _ = model.mesh_at(model.lod_max)
    unit = 2.0 ** np.ceil(np.log2(np.abs(vertices).max()))
    return ab.Model.from_arrays(np.round(vertices / unit * 4096) / 4096, faces)


def check_pair(device, model_a, pose_a, model_b, pose_b, lod):
    """Compare one pair at one LOD with brute force and return its faces."""
    case = (model_a, lod, pose_a, model_b, lod, pose_b)
    faces = ask(device, [case]).faces[:, 1:]
    np.testing.assert_array_equal(faces, true_faces(*case))
    return faces


QUARTER_TURN = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0.25], [0, 0, 1, 3], [0, 0, 0, 1]])


@pytest.mark.parametrize("name", ["torus", "soup", "grid", *slow("cow", "fcl-env")])
@pytest.mark.parametrize("place", ["still", "quarter turn", *slow("any turn")])
def test_coincident_meshes_equal_brute_force(device, name, place):
    """Every face is coplanar with its twin and touches its neighbours; at any other pose, a rounding apart."""
    model = rounded(name) if place == "quarter turn" else sample(name)
    lod = model.lod_for(fraction=min(1.0, (200 if name in SHAPES else 1000) / model.face_count))
    anywhere = random_poses(np.random.default_rng(10), 1, 1.0)[0]
    pose = {"still": STILL, "quarter turn": QUARTER_TURN, "any turn": anywhere}[place]
    faces = check_pair(device, model, pose, model, pose, lod)
    if place != "any turn":
        assert {(f, f) for f in model.mesh_at(lod)[2]} <= set(map(tuple, faces.tolist()))
    if place == "quarter turn":
        np.testing.assert_array_equal(check_pair(device, model, STILL, model, STILL, lod), faces)
    if place == "any turn" and name in ("cow", "fcl-env", "torus"):  # few pairs of the others differ
        scene = scene_of(device, [(model, lod, pose) * 2])
        rounded_faces = scene.intersect([(0, 1)], "faces", precision="float32").faces[:, 1:]
        assert not np.array_equal(rounded_faces, faces), "the case is too easy to tell exact signs from others"


@pytest.mark.parametrize("far", [1e6, 1e30, 1e39, 1e300, 1.7e308])
def test_pairs_far_apart(device, far):
    """Beyond float32, even where the distance overflows float64, the answer is no and costs nothing."""
    scene = in_a_row(device, "small ball", (0, far, -far, far))
    for place in ((0, far, 0), (0, 0, far), (0, -far, 0), (0, 0, -far)):
        scene.add(sample("small ball"), (*place, 0, 0, 0, 1))
    pairs = [(i, j) for i in range(8) for j in range(8) if i != j]
    result = scene.intersect(pairs, "faces")
    apart = np.array([{*pair} != {1, 3} for pair in pairs])
    np.testing.assert_array_equal(result.any, ~apart)
    assert (result.node_tests[apart] <= 2).all() and (result.triangle_tests[apart] == 0).all()
    assert (result.count[~apart] >= sample("small ball").face_count).all()


@pytest.mark.parametrize("room", [STACK_LENGTH, 0])
@pytest.mark.parametrize("parts", [1, 5, 300])
@pytest.mark.parametrize("small", [0, 96, 10**6])
@pytest.mark.slow
def test_warps_give_the_same_answers(device, room, parts, small):
    """One warp a pair and several, with room on the stack or none, so that they go one item at a time; trees level by
    level, or at once where their leaves have room."""
    rng = np.random.default_rng(8)
    scene = scene_of(device, [random_case(rng, ("torus", "soup"), BRUTE_FACES) for _ in range(12)])
    # Coincident meshes; and corners in common, where faces in one plane wait for exact signs.
    for name, x in (("torus", 0.0), ("torus", 0.0), ("grid", 0.0), ("grid", 0.0), ("grid", 0.03125)):
        scene.add(sample(name), (x, x / 2, 0, 0, 0, 0, 1), lod=sample(name).lod_for(fraction=0.2))
    pairs = np.arange(24).reshape(-1, 2)
    pairs = np.concatenate([pairs, pairs[::-1, ::-1], [(0, 3), (2, 9), (24, 25), (26, 27), (26, 28), (28, 26)]])
    visits = {}
    for output in ("faces", "count", "any"):
        with testing.regime(plain_tests=10**9, small_faces=0):  # slabs of the CPU save tests, small trees do on CUDA
            plain = ab.Query(scene, output, pairs=pairs).run()
        with testing.regime(warps=True, warps_per_pair=parts, stack_length=room, small_faces=small, slabs=False):
            query = ab.Query(scene, output, pairs=pairs, capacity=ab.Buffers(uncertain=2))
        result = query.run()
        visits[output] = result.node_tests.sum()
        np.testing.assert_array_equal(result.any, plain.any)
        if output != "any":
            np.testing.assert_array_equal(result.count, plain.count)
            # Boxes of leaves are tighter where trees are compared at once.
            for name in ("triangle_tests", "float64_tests", "exact_tests") if small == 0 else ():
                np.testing.assert_array_equal(getattr(result, name), getattr(plain, name))
            assert (result.triangle_tests <= plain.triangle_tests).all()
            assert (result.triangle_tests < plain.triangle_tests).any() == (small > 0)
        if output == "faces":
            np.testing.assert_array_equal(result.faces, plain.faces)
            assert len(result.faces) > 100
            assert result.exact_tests[-1] > 2, "the list of uncertain pairs has grown"
    if parts == 1:
        assert visits["any"] < visits["count"], "a pair ends at its first hit"


def test_small_and_large_trees_by_turns(device):
    """One query at LODs where warps wait for one another and where none does, many pairs more than warps too."""
    rng = np.random.default_rng(11)
    model, count = sample("torus"), 40
    coarse, fine = model.lod_for(fraction=40 / model.face_count), model.lod_max
    cases = [(model, fine, *random_poses(rng, 1, 0.3), model, fine, *random_poses(rng, 1, 0.3)) for _ in range(count)]
    scene = scene_of(device, cases)
    mixed = np.where(np.arange(scene.object_count) % 3 == 0, fine, coarse)
    pairs = np.tile(pairs_of(cases), (25, 1))
    queries = {output: GpuQuery(scene, output, pairs=pairs) for output in ("faces", "any")}
    for lods in (coarse, fine, coarse, mixed, coarse):
        scene.set_lods(np.broadcast_to(lods, scene.object_count))
        with testing.regime(small_faces=0):
            plain = ab.Query(scene, "faces", pairs=pairs).run()
        faces, alone = queries["faces"].run(), queries["any"].run()
        np.testing.assert_array_equal(faces.faces, plain.faces)
        np.testing.assert_array_equal([faces.any, alone.any], [plain.any] * 2)
        assert faces.any.any() and (np.diff(faces.count.reshape(-1, count), axis=0) == 0).all()


def test_coincident_meshes_go_to_float64_at_once(device):
    """Of twins in one place all faces, of a copy's those that float32 leaves open: the answers are the same."""
    model, pose = sample("soup"), random_poses(np.random.default_rng(12), 1, 1.0)[0]
    scene = scene_with(device, *[(placed, pose) for placed in (model, model, copy.copy(model))])
    result = scene.intersect([(0, 1), (0, 2)], "faces")
    first, second = (result.faces[result.faces[:, 0] == p, 1:] for p in range(2))
    np.testing.assert_array_equal(first, second)
    tested, left = result.triangle_tests, result.float64_tests
    assert left[0] == tested[0] == tested[1] > left[1]
    scene.set_lods([model.lod_max, *[model.lod_for(fraction=0.3)] * 2])
    apart = scene.intersect([(0, 1), (0, 2)], "faces")  # no twins
    assert (apart.float64_tests < apart.triangle_tests).all() and np.ptp(apart.float64_tests) == 0


@pytest.mark.parametrize("name", [*slow("cow", "rocker-arm", "stanford-bunny"), "torus"])
@pytest.mark.parametrize("fraction", [0.1, 0.03, 0.01])
def test_a_coarse_tree_costs_no_more_than_one_built_for_its_lod(device, name, fraction):
    """Skip links keep "no loss" true: node tests within 1.1 times those of a static tree, over 20 poses in contact."""
    model = sample(name)
    lod = model.lod_for(fraction=fraction)
    static = ab.Model.from_arrays(*model.mesh_at(lod)[:2])
    rng = np.random.default_rng(9)
    poses = [contact_poses(rng, model, lod, model, lod) for _ in range(20)]
    with testing.regime(plain_tests=10**9, slabs=False):  # slabs save tests
        ours = ask(device, [(model, lod, pose_a, model, lod, pose_b) for pose_a, pose_b in poses], output="count")
        theirs = ask(device, [(static, None, pose_a, static, None, pose_b) for pose_a, pose_b in poses], output="count")
    np.testing.assert_array_equal(ours.count, theirs.count)
    assert ours.node_tests.sum() <= 1.1 * theirs.node_tests.sum()


POISONED = """
import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

ball = trimesh.creation.icosphere(2)
scene = ab.Scene("cpu")
scene.add(ab.Model.from_arrays(ball.vertices, ball.faces))
scene.add(ab.Model.from_arrays(np.array([[-99.0, -99, 0], [99, -99, 0], [0, 99, 0]]), [[0, 1, 2]]))
states = scene.batch().states.pool
nodes = states.node_box.numpy()
poison = np.full((4096, 4), 2**29 + 12345, np.int32).view(np.float32)
states.node_box = wp.array(np.concatenate([nodes, poison]), dtype=wp.vec4, device="cpu")
query = ab.Query(scene, "faces", pairs=[(0, 1)])
poses = np.tile(np.eye(4), (2, 1, 1))
for z in np.linspace(-0.9, 0.9, 40):
    poses[0, :3, 3] = z / 3, 0, z
    scene.set_poses(poses)
    assert query.run().any.all()
"""


@pytest.mark.slow
def test_nothing_beyond_the_nodes_is_read():
    """Beyond them lie records that lead far out of memory: a process of its own ends where it reads there."""
    done = subprocess.run([sys.executable, "-c", POISONED], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
