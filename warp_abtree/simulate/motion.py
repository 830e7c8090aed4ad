"""Prescribed motion of objects over time, in closed form: `Kinematic`."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_abtree.checks.arguments import broadcast_rows, to_numpy
from warp_abtree.checks.quaternions import multiply_quaternions, quaternions_about
from warp_abtree.state.poses import check_poses


def triangle_wave(phase) -> np.ndarray:
    """Return 0 at whole numbers, 1 halfway between them, linear in between; any shape, float64."""
    phase = np.asarray(phase, np.float64)
    fraction = phase - np.floor(phase)
    return 1.0 - np.abs(2.0 * fraction - 1.0)


@dataclass(eq=False)
class Kinematic:
    """Prescribed motion of n objects.

    The position at time t is position + velocity t + wave(t / period + phase) shuttle, where the triangle wave runs
    from 0 to 1 and back. The rotation at time t is the start rotation, followed by a rotation of rate t about the axis
    through the object's own origin. A single row, or number, serves all objects.

    Attributes:
        position: Start [units], float64 (n, 3).
        rotation: Start quaternions x y z w, normalised, (n, 4).
        velocity: Linear velocity [units/s], (n, 3).
        axis: Axis of rotation in the world, normalised, (n, 3).
        rate: Angular speed about it [rad/s], (n,).
        shuttle: Displacement from one end of the shuttle to the other [units], (n, 3).
        period: Time there and back [s], above 0, (n,); inf stands still.
        phase: Fraction of a period by which the shuttle is ahead, (n,).

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, a quaternion whose norm is off 1 by more than
            1e-3, a rotation about an axis of length 0, a period not above 0.
    """

    position: Any
    rotation: Any = (0.0, 0.0, 0.0, 1.0)
    velocity: Any = (0.0, 0.0, 0.0)
    axis: Any = (0.0, 0.0, 1.0)
    rate: Any = 0.0
    shuttle: Any = (0.0, 0.0, 0.0)
    period: Any = np.inf
    phase: Any = 0.0

    def __post_init__(self):
        self.position = to_numpy(self.position, "position").astype(np.float64)
        if self.position.ndim != 2 or self.position.shape[1] != 3:
            raise ValueError(f"position: shape {self.position.shape}, not (n, 3)")
        n = len(self.position)
        shapes = dict(
            position=(n, 3), rotation=(n, 4), velocity=(n, 3), axis=(n, 3), shuttle=(n, 3), rate=(n,), phase=(n,)
        )
        for name, shape in (shapes | {"period": (n,)}).items():
            setattr(self, name, broadcast_rows(getattr(self, name), name, shape, is_finite=name in shapes))
        if not (self.period > 0).all():
            raise ValueError("period: not above 0")
        check_poses(np.concatenate([self.position, self.rotation], axis=1), "rotation")
        self.rotation /= np.linalg.norm(self.rotation, axis=1, keepdims=True)
        length = np.linalg.norm(self.axis, axis=1, keepdims=True)
        if ((length[:, 0] == 0) & (self.rate != 0)).any():
            raise ValueError("axis: an object rotates about an axis of length 0")
        self.axis /= np.where(length > 0, length, 1.0)

    def __len__(self) -> int:
        return len(self.position)

    def poses(self, time: float, out=None) -> np.ndarray:
        """Return the pose of every object at a time [s]: x y z qx qy qz qw, unit quaternions, float64 (n, 7).

        Args:
            time: Seconds since the start; may be negative.
            out: Array to write into, float64 (n, 7).
        """
        if out is None:
            out = np.empty((len(self), 7))
        wave = triangle_wave(time / self.period + self.phase)
        out[:, :3] = self.position + self.velocity * time + self.shuttle * wave[:, None]
        rotated = multiply_quaternions(quaternions_about(self.axis, self.rate * time), self.rotation)
        out[:, 3:] = rotated / np.linalg.norm(rotated, axis=1, keepdims=True)
        return out
