"""Points against a model or a scene: signed distances, nearest points and faces, containment.

A closed surface divides space into inside and outside however it is wound, at every LOD; sides are decided exactly, by
the parity of the crossings of a ray, as those of solids (`warp_abtree.state.solids`). A distance errs by 2^-45 of the
sizes of model and point at most; a point on the surface has distance 0, or that error on either side. In a scene that
holds of R^T (p - t), the point in the frame of an object that R and t pose, as float64 rounds it.
"""

import weakref

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag, to_numpy, whole_number
from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.inside import point_distance as kernels
from warp_abtree.model.mesh import COORDINATE_MAX
from warp_abtree.model.model import Model
from warp_abtree.model.winding import check_solid
from warp_abtree.query.request import check_within
from warp_abtree.scene.objects import check_models
from warp_abtree.scene.posed_objects import PosedObjects

# Points of a thread: the next starts from the last one's nearest face.
RUNS = {"cpu": 256, "cuda": 1}
# Models whose device arrays are kept for the next call.
KEPT_MODELS = 4
TOO_FAR = "has a coordinate beyond 2^300, the most that a mesh may have"
OUTPUTS = "distance", "object", "nearest", "face"

_kept: dict[tuple, tuple] = {}


def signed_distance(
    model: Model, points, lod=None, device=None, signed: bool = True, nearest: bool = False, *, within=None
):
    """Return the distances of points from a model's surface, negative inside. Waits for the device.

    Args:
        points: (n, 3) in the model's frame [model units], of any framework.
        lod: LOD of the model; None is the finest.
        device: Warp device; None for Warp's default.
        signed: Whether insides count; False takes meshes that are not closed, too.
        nearest: Whether to return the nearest points on the surface and their faces as well.
        within: Distance [model units] up to which the surface is looked for, which takes less time: of points farther
            away distances are infinite, -inf inside, nearest points NaN, and faces -1. None for no end.

    Returns:
        Distances, float64 (n,); with `nearest` also points, float64 (n, 3), and faces of the file, int32 (n,).

    Raises:
        TypeError: model is no Model.
        MeshError: The mesh is not closed and has no inside; the message names edges.
        ValueError: Points of another shape, not finite or beyond 2^300, the first is named; a LOD out of range, no such
            device, a bad `within`.
    """
    (model,) = check_models(model, 1)
    if flag(signed, "signed"):
        check_solid(model.winding, model.name, stacklevel=3)
    return_nearest, lod = flag(nearest, "nearest"), model.lod_max if lod is None else model.check_lod(lod)
    points = _check_points(points)
    scene = _find_scene(model, lod, device)
    check_device(scene.device, "ab.signed_distance")
    names = ("distance", "nearest", "face") if return_nearest else ("distance",)
    found = _measure(scene, [(0, signed)], points, within, names)
    return found if return_nearest else found[0]


def contains(model: Model, points, lod=None, device=None) -> np.ndarray:
    """Return which points lie inside a closed model, bool (n,); arguments and errors are those of `signed_distance`."""
    return signed_distance(model, points, lod, device, within=0.0) < 0


def object_distances(scene: PosedObjects, points, world, signed, within, nearest) -> tuple:
    """Find the distances of points from the objects of a scene, see `Scene.signed_distance`."""
    check_device(scene.device, "Scene.signed_distance")
    signed, nearest, points = flag(signed, "signed"), flag(nearest, "nearest"), _check_points(points)
    world = whole_number(world, "world", -1, 2**31 - 1)
    objects = np.flatnonzero(scene.present & np.isin(scene.worlds, (world, -1)))
    if not len(objects):
        raise ValueError(f"the scene has no object in world {world}")
    solid = np.array(scene.object_solid)[objects] & signed
    if signed and not solid.any():
        raise ValueError(
            f"signed: no object of world {world} is a solid; give solid=True to Scene.add, or signed=False"
        )
    return _measure(scene, np.column_stack([objects, solid]), points, within, [*OUTPUTS][: None if nearest else 2])


def _measure(scene, asked, points, within, names) -> tuple:
    """Return outputs of points from objects of a scene, rows of (object, whether it has an inside), by their names."""
    most = np.inf if within is None else float(check_within(within, known="points: one distance for all"))
    batch, n, device = scene.batch(), len(points), scene.device
    found = zeros_of(kernels.PointDistances, n, 0, device)
    if n:
        rows = wp.array(points, dtype=wp.vec3d, device=device)
        run = RUNS["cpu" if device.is_cpu else "cuda"]
        asked = wp.array(np.asarray(asked, np.int32), dtype=wp.vec2i, device=device)
        inputs = [run, wp.float64(most), batch.trees, asked, rows, _sort(points, rows), found]
        wp.launch(kernels.measure_point_kernel, -(-n // run), inputs, device=device, block_dim=64)
    return tuple(getattr(found, name).numpy() for name in names)


def _check_points(points) -> np.ndarray:
    points = to_numpy(points, "points")
    if points.shape == (0,):
        return np.empty((0, 3))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        raise ValueError(f"points: shape {points.shape} and type {points.dtype}, not numbers of shape (n, 3)")
    points = np.ascontiguousarray(points, np.float64)
    if not np.abs(points).max(initial=0.0) <= COORDINATE_MAX:
        for what, sound in (("is not finite", np.isfinite(points)), (TOO_FAR, np.abs(points) <= COORDINATE_MAX)):
            if not sound.all():
                raise ValueError(f"points: point {sound.all(1).argmin()} {what}")
    return points


def _sort(points, rows) -> wp.array:
    """Return indices of points along a Morton curve through their box."""
    # NumPy takes ten times as long along the first axis.
    lower = np.array([column.min() for column in points.T])
    cell = max(column.max() - low for column, low in zip(points.T, lower)) / 2 ** int(kernels.CODE_BITS)
    code, order = (wp.empty(2 * len(points), dtype=wp.int32, device=rows.device) for _ in range(2))
    inputs = [wp.vec3d(*lower), wp.float64(float(cell) or 1.0), rows, code, order]
    wp.launch(kernels.code_point_kernel, len(points), inputs, device=rows.device)
    radix_sort(code, order, len(points), 32)
    return order


def _find_scene(model, lod, device) -> PosedObjects:
    """Return a scene of one object at an LOD, which is kept while its model lives, or three others are asked."""
    scene = PosedObjects(device)
    key = id(model), lod, scene.device.alias
    kept = _kept.pop(key, None)
    if kept is None:
        scene.add(model, lod=lod)
        kept = scene, weakref.ref(model, lambda _: _kept.pop(key, None))
    _kept[key] = kept
    for old in list(_kept)[:-KEPT_MODELS]:
        _kept.pop(old, None)
    return kept[0]
