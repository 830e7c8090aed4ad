"""Distances as functions of all poses: PyTorch's and Warp's tapes against finite differences, and one another."""

from functools import cache

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.questions import to_matrix
from helpers.samples import random_poses, sample
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.interop.tape import record_pair_distance

NAMES = ("torus", "capsule", "small ball", "torus")
PAIRS = [(0, 1), (2, 0), (1, 3), (3, 2), (2, 1)]


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


@pytest.fixture
def pair_distance(torch):
    from warp_abtree.interop.torch import pair_distance

    return pair_distance


def objects():
    return [(sample(name), {"solid": True, "lod": sample(name).lod_for(fraction=0.3)}) for name in NAMES]


def make_query(device, pairs=PAIRS):
    """Return a signed query of four solids, and poses with some in one another and quaternions of any norm."""
    rng = np.random.default_rng(8)
    poses = random_poses(rng, 4, 1.4)
    poses[:, 3:] *= rng.uniform(0.2, 5.0, (4, 1))
    return ab.DistanceQuery(scene_with(device, *objects()), pairs, signed=True), poses


def distances_at(query, poses):
    """Return distances at poses whose quaternions are normalised here."""
    units = np.hstack([poses[:, :3], poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)])
    scene = scene_with(query.device, *[(model, unit, options) for (model, options), unit in zip(objects(), units)])
    return scene.intersect(query.given, "distance", signed=True).distance


def to_matrices(poses):
    parts = ((pose[:3], pose[3:]) for pose in poses)
    return np.array([to_matrix(quaternion_matrix(q / np.linalg.norm(q)), place) for place, q in parts])


def test_gradcheck_and_values(device, torch, pair_distance):
    query, poses = make_query(device)
    tensor = torch.tensor(poses, device=wp.device_to_torch(query.device), requires_grad=True)
    distance = pair_distance(query, tensor)
    assert distance.dtype == torch.float64 and distance.device == tensor.device
    found = distance.detach().cpu().numpy()
    np.testing.assert_allclose(found, distances_at(query, poses), rtol=0, atol=1e-14)
    assert (found < 0).sum() >= 1 and (found > 0).sum() >= 2
    assert torch.autograd.gradcheck(lambda given: pair_distance(query, given), tensor, eps=1e-6, atol=2e-5, rtol=0)
    (distance**2).sum().backward()
    along = (tensor.grad[:, 3:] * tensor[:, 3:]).sum(1).abs().max().item()
    assert along < 1e-12 and tensor.grad[:, 3:].abs().max() > 0.01
    # Twice as long a quaternion is the same pose, and has half of the gradient.
    twice = (tensor.detach() * torch.tensor([1, 1, 1, 2, 2, 2, 2.0], device=tensor.device)).requires_grad_()
    (pair_distance(query, twice) ** 2).sum().backward()
    np.testing.assert_allclose(twice.grad[:, 3:].cpu(), tensor.grad[:, 3:].cpu() / 2, rtol=1e-12, atol=1e-13)


def test_matrices_and_float32(device, torch, pair_distance):
    query, poses = make_query(device)
    place = wp.device_to_torch(query.device)
    weight = torch.linspace(-1, 1, len(PAIRS), device=place, dtype=torch.float64)
    matrices = torch.tensor(to_matrices(poses), device=place)
    parts = []
    for dtype in (torch.float64, torch.float32):
        turn = torch.zeros(4, 3, dtype=dtype, device=place, requires_grad=True)
        shift = torch.zeros(4, 3, dtype=dtype, device=place, requires_grad=True)
        x, y, z = turn.T
        o = torch.zeros_like(x)
        skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).reshape(4, 3, 3)
        given = matrices.to(dtype)
        moved = torch.cat([torch.matrix_exp(skew) @ given[:, :3, :3], (given[:, :3, 3] + shift)[..., None]], 2)
        moved = torch.cat([moved, given[:, 3:]], 1)
        distance = pair_distance(query, moved)
        assert distance.dtype == dtype
        (distance * weight.to(dtype)).sum().backward()
        parts.append(torch.cat([shift.grad, turn.grad], 1).double().cpu().numpy())
    expected, gradient = np.zeros((4, 6)), query.run().gradient
    for pair, twists, factor in zip(PAIRS, gradient, weight.tolist()):
        for i, twist in zip(pair, twists):
            expected[i] += factor * twist
    np.testing.assert_allclose(parts[1], expected, rtol=0, atol=1e-5)  # the query stands at these poses
    np.testing.assert_allclose(parts[0], parts[1], rtol=0, atol=1e-5)


def test_launches_in_between_and_other_pairs_change_nothing(device, torch, pair_distance):
    query, poses = make_query(device)
    first = torch.tensor(poses, device=wp.device_to_torch(query.device), requires_grad=True)
    other = first.detach().flip(0).clone().requires_grad_()
    alone = torch.autograd.grad(pair_distance(query, first).sum(), first)[0]
    one, two = pair_distance(query, first), pair_distance(query, other)
    query.set_pairs(PAIRS[:2])
    assert pair_distance(query, first).shape == (2,)
    (gradient,) = torch.autograd.grad(one.sum(), first)
    assert torch.equal(gradient, alone) and two.requires_grad
    with torch.no_grad():
        other += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        two.sum().backward()
    query.set_pairs(np.empty((0, 2), int))
    assert pair_distance(query, first).shape == (0,)


@wp.kernel
def weigh_kernel(distance: wp.array(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    i = wp.tid()
    wp.atomic_add(loss, 0, distance[i] * distance[i])


KINDS = {
    "rows": lambda poses: (poses, wp.float64),
    "transforms": lambda poses: (poses, wp.transformd),
    "float32": lambda poses: (poses, wp.transformf),
    "matrices": lambda poses: (to_matrices(poses), wp.float64),
}


@cache
def slopes_of_loss(device):
    """Return differences of the sum of squared distances by each number of the poses, (4, 7)."""
    query, poses = make_query(device)
    slopes = np.zeros((4, 7))
    for at in np.ndindex(4, 7):
        step = np.zeros((4, 7))
        step[at] = 1e-6
        before, after = ((distances_at(query, poses + sign * step) ** 2).sum() for sign in (-1, 1))
        slopes[at] = (after - before) / 2e-6
    return slopes


@pytest.mark.parametrize(
    ("kind", "outside"), [("rows", False), ("transforms", True), ("float32", False), ("matrices", True)]
)
def test_tape(device, kind, outside):
    """Gradients of a loss by poses of every type, recorded inside `with tape` or beside it, against differences."""
    query, poses = make_query(device)
    values, dtype = KINDS[kind](poses)
    given = wp.array(values, dtype=dtype, device=device, requires_grad=True)
    loss, tape = wp.zeros(1, dtype=wp.float64, device=device, requires_grad=True), wp.Tape()
    distance = record_pair_distance(tape, query, given) if outside else None
    with tape:
        distance = record_pair_distance(tape, query, given) if distance is None else distance
        wp.launch(weigh_kernel, len(PAIRS), [distance, loss], device=device)
    assert len(tape.launches) == 2
    for _ in range(2):
        tape.backward(loss)
        found = given.grad.numpy().reshape(4, -1).astype(float)
        tape.zero()
    slopes, tolerance = slopes_of_loss(device), 1e-4 if kind == "float32" else 2e-5
    if kind == "matrices":
        np.testing.assert_allclose(found[:, [3, 7, 11]], slopes[:, :3], rtol=0, atol=tolerance)
        assert not found[:, 12:].any()
        for row, pose, slope in zip(found, poses, slopes):
            for k in range(4):
                ends = [to_matrices([pose + sign * 1e-6 * np.eye(7)[3 + k]])[0].ravel() @ row for sign in (1, -1)]
                assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope[3 + k], abs=2e-5)
    else:
        np.testing.assert_allclose(found, slopes, rtol=0, atol=tolerance)


def test_bad_input_moves_nothing(device):
    query, poses = make_query(device)
    scene_poses = query.batch.objects.pool.position.numpy()
    tape, real = wp.Tape(), {"dtype": wp.float64, "device": device, "requires_grad": True}

    def refuse(values, match, kind=ValueError, asked=query, **options):
        given = wp.array(values, **{**real, **options})
        refused(kind, match, record_pair_distance, tape, asked, given)
        np.testing.assert_array_equal(query.batch.objects.pool.position.numpy(), scene_poses)

    zero, infinite = poses.copy(), poses.copy()
    zero[2, 3:], infinite[1, 0] = 0, np.inf
    refuse(zero, "pose 2 has a quaternion of norm 0")
    refuse(infinite, "pose 1 is not finite")
    refuse(2 * to_matrices(poses), "matrix 0 is not rigid")
    refuse(poses[:3], "3 given for 4 objects")
    refuse(poses[:, :6], "no contiguous")
    refuse(poses, "requires_grad", requires_grad=False)
    refuse(poses, "a DistanceQuery is expected", TypeError, ab.Query(make_query(device)[0].batch, pairs=PAIRS))
    refuse(poses, "broad phase", asked=ab.DistanceQuery(query.batch))
    assert not tape.launches
    given = wp.array(poses, **real)
    refused(TypeError, "tape: a wp.Tape is expected", record_pair_distance, None, query, given)
    scene = scene_with(device, *map(sample, NAMES))
    query = ab.DistanceQuery(scene, PAIRS)
    scene.add(sample("torus"))
    refused(RuntimeError, "objects were added", record_pair_distance, tape, query, wp.zeros((5, 7), **real))


def test_a_tape_of_no_pairs(device):
    query, poses = make_query(device, np.empty((0, 2), int))
    given = wp.array(poses, dtype=wp.float64, device=device, requires_grad=True)
    loss, tape = wp.zeros(1, dtype=wp.float64, device=device, requires_grad=True), wp.Tape()
    with tape:
        distance = record_pair_distance(tape, query, given)
        wp.launch(weigh_kernel, len(distance), [distance, loss], device=device)
    tape.backward(loss)
    assert distance.shape == (0,) and not given.grad.numpy().any()


def test_bad_tensors(device, torch, pair_distance):
    query, poses = make_query(device)
    refused(TypeError, "torch.Tensor is expected", pair_distance, query, poses)
    refused(TypeError, "not a torch.sparse_coo", pair_distance, query, torch.tensor(poses, device=device).to_sparse())
    refused(ValueError, "no contiguous", pair_distance, query, torch.tensor(poses, device=device).half())
    if query.device.is_cuda:
        refused(ValueError, "the query is on cuda", pair_distance, query, torch.tensor(poses))
