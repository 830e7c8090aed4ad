"""The camera, and what it measures of each object: distance, motion on the screen, and focus."""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import finite_array, positive, whole_number
from warp_abtree.checks.upload import Upload, struct_of
from warp_abtree.kernels.lod import view as kernels

AXES = {f"{sign}{name}": f * axis for sign, f in (("", 1), ("-", -1)) for name, axis in zip("xyz", np.eye(3))}


def as_direction(value, what: str = "up") -> np.ndarray:
    """Return a direction as float64 (3,): of an axis, as "z" or "-y", or as it is; raise ValueError for another."""
    if isinstance(value, str):
        if value not in AXES:
            raise ValueError(f"{what}: {value!r} is none of {', '.join(AXES)}, and no three numbers")
        return AXES[value]
    vector = finite_array(value, what, (3,))
    if not vector.any():
        raise ValueError(f"{what}: a direction of no length")
    return vector


@dataclass(frozen=True, eq=False)
class Camera:
    """Position and projection of the viewer.

    Attributes:
        eye: Position [world units], (3,).
        view: Rows right, up, towards the eye: the rotation of the view matrix, (3, 3).
        field_of_view: Vertical angle [rad].
        size: Width and height of the screen [pixels].
        far: D of the paper, how far one sees [world units].

    Raises:
        ValueError: A number that is not finite or not above 0, an angle of 180 degrees or more, rows that are no
            rotation within 1e-6.
    """

    eye: np.ndarray
    view: np.ndarray
    field_of_view: float = math.radians(60.0)
    size: tuple[int, int] = (1920, 1080)
    far: float = 100.0

    def __post_init__(self):
        object.__setattr__(self, "eye", finite_array(self.eye, "eye", (3,)))
        view = finite_array(self.view, "view", (3, 3))
        if not np.abs(view @ view.T - np.eye(3)).max() <= 1e-6 or not np.linalg.det(view) > 0:
            raise ValueError("view: the rows are no rotation")
        object.__setattr__(self, "view", view)
        if not positive(self.field_of_view, "field_of_view") < math.pi:
            raise ValueError(f"field_of_view {self.field_of_view!r} is 180 degrees or more")
        for side in finite_array(self.size, "size", (2,)):
            positive(side, "size")
        positive(self.far, "far")

    @classmethod
    def look_at(cls, eye, target, up=None, **options) -> "Camera":
        """Return a camera at `eye` that looks at `target`, both in world units, with `up` upwards on its screen.

        Args:
            eye, target: Points [world units], (3,).
            up: Axis, as "z" or "-y", or a direction, (3,); None is z, or y where the camera looks along z.
            options: field_of_view, size and far of the camera.

        Raises:
            ValueError: `target` is `eye`, or `up` points along the view.
        """
        back = finite_array(eye, "eye", (3,)) - finite_array(target, "target", (3,))
        if up is None:
            up = "z" if back[:2].any() else "y"
        up = as_direction(up)
        right = np.cross(up, back)
        length = np.linalg.norm(back), np.linalg.norm(right)
        if not length[0] > 0 or not length[1] > 1e-9 * length[0] * np.linalg.norm(up):
            raise ValueError("the camera looks at its own eye, or along up")
        back, right = back / length[0], right / length[1]
        return cls(eye, np.stack([right, np.cross(back, right), back]), **options)

    def packed(self) -> np.ndarray:
        """Return what kernels read: eye, rows, focal length and diagonal W [pixels], D; float64 (15,)."""
        width, height = self.size
        focal = 0.5 * height / math.tan(0.5 * self.field_of_view)
        return np.concatenate([self.eye, self.view.ravel(), [focal, math.hypot(width, height), self.far]])


class View:
    """Operator: alpha, gamma and f of every object, as the scene stands.

    Args:
        scene: `Scene` with all its objects.
        window: Frames over which gamma is summed.

    Attributes:
        distance: alpha, from the eye to the middle of the object [world units], float64 (n,) on the device.
        motion: gamma, length of its path on the screen over the last `window` launches [pixels], float64 (n,);
            positions behind the camera add nothing.
        arrays: `kernels.lod.view.ViewArrays`.
        focus: f = min((D - alpha) / D, (W - gamma) / W) within [0, 1], float64 (n,); 1 before any camera.
    """

    def __init__(self, scene, window: int = 10):
        self.scene = scene
        self.window = whole_number(window, "window", 1, 1000)
        self.batch, self.device = scene.batch(), scene.device
        self._camera, count = Upload(15, self.device), scene.object_count
        self.arrays = struct_of(
            kernels.ViewArrays,
            self.device,
            window=self.window,
            object_model=scene.object_model,
            centre=self.batch.models.pool.centre,
            camera=self._camera.array,
            frame=np.zeros(count),
            screen=np.zeros((count, 3)),
            path=np.zeros(self.window * count),
            distance=np.zeros(count),
            motion=np.zeros(count),
            focus=np.ones(count),
        )
        self.distance, self.motion, self.focus = self.arrays.distance, self.arrays.motion, self.arrays.focus

    def look(self, camera: Camera):
        """Set the camera from the next launch on; a captured graph reads it at every launch."""
        self._camera.send(camera.packed())

    def check(self):
        """Raise RuntimeError if the scene's objects changed since the operator was made."""
        self.batch.check("selection")

    def launch(self):
        """Measure, in one launch; raise RuntimeError where the scene's objects changed."""
        self.check()
        pool = self.batch.objects.pool
        inputs = [pool.rotation, pool.position, self.arrays]
        wp.launch(kernels.measure_view_kernel, dim=len(self.focus), inputs=inputs, device=self.device)
