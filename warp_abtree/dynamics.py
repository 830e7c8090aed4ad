"""Motion of objects over time. Kinematic only: poses are prescribed in closed form, nothing pushes back.

Rigid bodies with mass, contact response and a stepper come later.
"""

from dataclasses import dataclass

import numpy as np

AXIS_TOLERANCE = 1e-3


def triangle_wave(phase) -> np.ndarray:
    """Return 0 at whole numbers, 1 halfway between them, linear in between; any shape, float64."""
    phase = np.asarray(phase, np.float64)
    fraction = phase - np.floor(phase)
    return 1.0 - np.abs(2.0 * fraction - 1.0)


def multiply_quaternions(p, q) -> np.ndarray:
    """Return p q, the rotation q followed by p; quaternions x y z w, shape (..., 4), float64."""
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
    """Return quaternions x y z w of rotations by an angle [rad] about unit axes, (..., 3) and (...,) to (..., 4)."""
    half = 0.5 * np.asarray(angle, np.float64)[..., None]
    return np.concatenate([np.asarray(axis, np.float64) * np.sin(half), np.cos(half)], axis=-1)


def _rows(values, count, width, what):
    values = np.asarray(values, np.float64)
    shape = (count,) if width is None else (count, width)
    try:
        values = np.broadcast_to(values, shape).copy()
    except ValueError:
        raise ValueError(f"{what}: shape {values.shape} does not stretch to {shape}") from None
    return values


@dataclass(eq=False)
class Kinematic:
    """Prescribed motion of n objects.

    At time t an object stands at position + velocity t + wave(t / period + phase) shuttle, where the wave runs from 0
    to 1 and back in straight lines, and is turned by rate t about its axis through its own origin, after its start
    rotation. A single row, or number, serves all objects.

    Attributes:
        position: Start [units], float64 (n, 3).
        rotation: Start quaternions x y z w, normalised, (n, 4).
        velocity: Linear velocity [units/s], (n, 3).
        axis: Turning axis in the world, normalised, (n, 3).
        rate: Turning rate [rad/s], (n,).
        shuttle: Way from one end of the shuttle to the other [units], (n, 3).
        period: Time there and back [s], above 0, (n,); inf stands still.
        phase: Part of a period by which the shuttle is ahead, (n,).

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, a quaternion whose norm is off 1 by more than
            1e-3, an axis of no length that turns, a period not above 0.
    """

    position: np.ndarray
    rotation: np.ndarray = (0.0, 0.0, 0.0, 1.0)
    velocity: np.ndarray = (0.0, 0.0, 0.0)
    axis: np.ndarray = (0.0, 0.0, 1.0)
    rate: np.ndarray = 0.0
    shuttle: np.ndarray = (0.0, 0.0, 0.0)
    period: np.ndarray = np.inf
    phase: np.ndarray = 0.0

    def __post_init__(self):
        self.position = np.array(self.position, np.float64)
        if self.position.ndim != 2 or self.position.shape[1] != 3:
            raise ValueError(f"position: shape {self.position.shape}, not (n, 3)")
        n = len(self.position)
        for name, width in (("rotation", 4), ("velocity", 3), ("axis", 3), ("shuttle", 3)):
            setattr(self, name, _rows(getattr(self, name), n, width, name))
        for name in ("rate", "period", "phase"):
            setattr(self, name, _rows(getattr(self, name), n, None, name))
        for name in ("position", "rotation", "velocity", "axis", "rate", "shuttle", "phase"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name}: a number is not finite")
        if not (self.period > 0).all():
            raise ValueError("period: not above 0")
        norm = np.linalg.norm(self.rotation, axis=1, keepdims=True)
        if (np.abs(norm - 1) > AXIS_TOLERANCE).any():
            raise ValueError("rotation: the norm of a quaternion is off 1 by more than 1e-3")
        self.rotation /= norm
        length = np.linalg.norm(self.axis, axis=1, keepdims=True)
        if ((length[:, 0] == 0) & (self.rate != 0)).any():
            raise ValueError("axis: an object turns about an axis of no length")
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
        turned = multiply_quaternions(quaternions_about(self.axis, self.rate * time), self.rotation)
        out[:, 3:] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return out
