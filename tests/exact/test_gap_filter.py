"""Face pairs that float32 calls farther apart than a gap: by planes, or beyond an edge, never where they are not."""

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch
from helpers.samples import random_quaternions
from oracles.triangle import quaternion_matrix
from oracles.triangle_distance import separation

from warp_abtree.kernels import native
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, gap_signs
from warp_abtree.kernels.triangle.signs import SEPARATED

wp.set_module_options(native.options("triangle/float32_filter.cuh"))
COUNT, ROW = 1500, 6


@wp.kernel
def gap_signs_kernel(
    error: wp.array[float], gap: wp.array[float], corners: wp.array2d[wp.vec3], separated_out: wp.array[int]
):
    i = wp.tid()
    a = wp.matrix_from_rows(corners[i, 0], corners[i, 1], corners[i, 2])
    b = wp.matrix_from_rows(corners[i, 3], corners[i, 4], corners[i, 5])
    separated_out[i] = wp.where(gap_signs(error[i], FLOAT32_UNIT, gap[i], a, b) == SEPARATED, 1, 0)


def face_pairs(kind, rng):
    """Return corners of two faces each, (COUNT, 6, 3): anywhere, side by side in one plane, or slivers so."""
    corners = rng.uniform(-1, 1, (COUNT, ROW, 3)) * 10.0 ** rng.uniform(-5, 0, (COUNT, 1, 1))
    if kind != "anywhere":
        corners[:, :3, 0] -= corners[:, :3, 0].max(1, keepdims=True)
        corners[:, 3:, 0] += 10.0 ** rng.uniform(-7, 0, (COUNT, 1)) - corners[:, 3:, 0].min(1, keepdims=True)
        corners[..., 2] *= 10.0 ** rng.uniform(-9, -1, (COUNT, 1))
    if kind == "slivers":
        corners[..., 1] *= 10.0 ** rng.uniform(-7, 0, (COUNT, 1))
    turns = np.stack([quaternion_matrix(q) for q in random_quaternions(rng, COUNT)])
    return corners @ turns + rng.uniform(-1, 1, (COUNT, 1, 3)) * 10.0 ** rng.uniform(-6, 0, (COUNT, 1, 1))


@pytest.mark.parametrize("off", [0.0, 2.0**-22, 2.0**-12])
@pytest.mark.parametrize("kind", ["anywhere", "side by side", "slivers"])
def test_no_face_within_a_gap_is_dropped(device, kind, off):
    """Gaps a little more than the distance, of coordinates moved by up to `off` and rounded to float32."""
    corners = face_pairs(kind, np.random.default_rng(3))
    moved = (corners + off * np.random.default_rng(4).uniform(-1, 1, corners.shape)).astype(np.float32)
    given = moved.astype(float) if off == 0.0 else corners
    distance = np.array([max(0.0, separation(pair[:3], pair[3:])[0]) for pair in given])
    error = (2.02 * np.abs(moved - given).max((1, 2))).astype(np.float32)
    dropped = [
        launch(gap_signs_kernel, device, COUNT, error, (factor * distance).astype(np.float32), moved)
        for factor in (1.0 + 2.0**-22, 0.9)
    ]
    assert not dropped[0].any()
    if off == 0.0 and kind == "side by side":
        assert dropped[1].mean() > 0.6, "of these planes drop few"
