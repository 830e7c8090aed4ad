"""Unit quaternions x y z w and rotation matrices on the host, float64."""

import numpy as np


def multiply_quaternions(p, q) -> np.ndarray:
    """Return p q, the rotation q followed by p; shape (..., 4)."""
    px, py, pz, pw = np.moveaxis(np.asarray(p, np.float64), -1, 0)
    qx, qy, qz, qw = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    return np.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def quaternions_about(axis, angle) -> np.ndarray:
    """Return the quaternions of rotations by an angle [rad] about unit axes, (..., 3) and (...,) to (..., 4)."""
    half = 0.5 * np.asarray(angle, np.float64)[..., None]
    return np.concatenate([np.asarray(axis, np.float64) * np.sin(half), np.cos(half)], axis=-1)


def quaternions_of(matrices) -> np.ndarray:
    """Return the unit quaternions, w >= 0, of rotation matrices, (n, 3, 3) to (n, 4)."""
    m = np.asarray(matrices, np.float64)
    x, y, z = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # 4 q q^T, of which the row of the largest component has the most digits.
    square = np.empty((len(m), 4, 4))
    for i, d in enumerate((x - y - z, y - x - z, z - x - y, x + y + z)):
        square[:, i, i] = 1 + d
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        square[:, i, j] = square[:, j, i] = m[:, i, j] + m[:, j, i]
        square[:, 3, k] = square[:, k, 3] = m[:, j, i] - m[:, i, j]
    best = np.argmax(np.einsum("nii->ni", square), axis=1)
    q = square[np.arange(len(m)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True) * np.where(q[:, 3:] < 0, -1.0, 1.0)


def matrices_of(quaternions) -> np.ndarray:
    """Return the rotation matrices of quaternions, which are normalised, (n, 4) to (n, 3, 3)."""
    q = np.asarray(quaternions, np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
