"""Points against a model or a scene: signed distances, nearest points and faces, containment.

A closed surface divides space into inside and outside however it is wound, at every LOD; sides are decided exactly, by
the parity of the crossings of a ray, as those of solids (`warp_abtree.state.solids`). A distance errs by 2^-45 of the
sizes of model and point at most; a point on the surface has distance 0, or that error on either side. In a scene that
holds of R^T (p - t), the point in the frame of an object that R and t pose, as float64 rounds it.
"""

import weakref
from functools import cache, lru_cache
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag, to_numpy, whole_number
from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.inside import point_distance as kernels
from warp_abtree.model.mesh import COORDINATE_MAX
from warp_abtree.model.model import Model
from warp_abtree.model.winding import check_solid
from warp_abtree.query.request import check_within
from warp_abtree.scene.objects import check_models
from warp_abtree.scene.posed_objects import PosedObjects
from warp_abtree.state.batch import Batch

# Points of a thread of the CPU: the next starts from the last one's nearest face.
RUN = 256
# Points of a warp: with more the last warps run alone, with fewer lanes wait.
POINTS_OF_WARP = 8
# Models whose device arrays are kept for the next call.
KEPT_MODELS = 4
BOUND_THREADS = 4096
OUTPUTS = "distance", "object", "nearest", "face"

_kept: dict[tuple, tuple] = {}


def signed_distance(
    model: Model, points, lod=None, device=None, signed: bool = True, nearest: bool = False, *, within=None
):
    """Return the distances of points from a model's surface, negative inside. Waits for the device.

    Args:
        points: (n, 3) in the model's frame [model units], of any framework. A Warp array of vec3d on a GPU stays there,
            and so do the results, Warp arrays of their own.
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
        check_solid(model.winding, model.name)
    return_nearest, lod = flag(nearest, "nearest"), model.lod_max if lod is None else model.check_lod(lod)
    if _is_on_gpu(points):
        device = points.device if device is None else device
    batch = _find_batch(model, lod, device)
    names = ("distance", "nearest", "face") if return_nearest else ("distance",)
    found = _measure(batch, [(0, signed)], points, within, names)
    return found if return_nearest else found[0]


def contains(model: Model, points, lod=None, device=None) -> np.ndarray:
    """Return which points lie inside a closed model, bool (n,); arguments and errors are those of `signed_distance`."""
    return to_numpy(signed_distance(model, points, lod, device, within=0.0), "distance") < 0


def object_distances(scene: PosedObjects, points, world, signed, within, nearest) -> tuple:
    """Find the distances of points from the objects of a scene, see `Scene.signed_distance`."""
    check_device(scene.device, "Scene.signed_distance")
    signed, nearest = flag(signed, "signed"), flag(nearest, "nearest")
    world = whole_number(world, "world", -1, 2**31 - 1)
    objects = np.flatnonzero(scene.present & np.isin(scene.worlds, (world, -1)))
    if not len(objects):
        raise ValueError(f"the scene has no object in world {world}")
    solid = np.array(scene.object_solid)[objects] & signed
    if signed and not solid.any():
        raise ValueError(
            f"signed: no object of world {world} is a solid; give solid=True to Scene.add, or signed=False"
        )
    asked, names = np.column_stack([objects, solid]), [*OUTPUTS][: None if nearest else 2]
    return _measure(scene.batch(), asked, points, within, names)


def _measure(batch: Batch, asked, points, within, names) -> tuple:
    """Return outputs of points from objects of a batch, rows of (object, whether it has an inside), by their names."""
    most = np.inf if within is None else float(check_within(within, known="points: one distance for all"))
    device, stays = batch.device, _is_on_gpu(points)
    if stays and points.device != device:
        raise ValueError(f"points: on {points.device}, the model or scene is on {device}")
    rows, bounds = _bound_on_gpu(points) if stays else _bound_on_host(points, device)
    n = len(rows)
    found = kernels.PointDistances()
    for name in names:
        dtype = kernels.PointDistances.vars[name].type.dtype
        setattr(found, name, wp.empty(n, dtype=dtype, device=device))
    if n:
        asked = _asked_objects(tuple(map(tuple, asked)), device.alias)
        inputs = [wp.float64(most), batch.trees, asked, rows, _sort(rows, bounds), bounds, found]
        kernel, run, lanes = kernels.measure_point_kernel, RUN, 1
        if current_regime().uses_warps(device):
            kernel = kernels.measure_points_of_warp_kernel
            run, lanes = (POINTS_OF_WARP, WARP_SIZE) if device.is_cuda else (1, 1)
        wp.launch(kernel, -(-n // run) * lanes, [run, *inputs], device=device, block_dim=WARP_SIZE)
    if stays:
        _check_on_gpu(points, bounds)
    return tuple(getattr(found, name) if stays else getattr(found, name).numpy() for name in names)


@lru_cache(maxsize=KEPT_MODELS)
def _asked_objects(asked: tuple, device: str) -> wp.array:
    return wp.array(np.array(asked, np.int32), dtype=wp.vec2i, device=device)


@cache
def _no_bounds(device: str) -> wp.array:
    """Return what the box of no points is for `bound_point_kernel`."""
    return wp.array([np.inf] * 3 + [-np.inf] * 3 + [np.inf], dtype=wp.float64, device=device)


def _is_on_gpu(points) -> bool:
    device: Any = points.device if isinstance(points, wp.array) else None
    return device is not None and device.is_cuda and points.dtype is wp.vec3d and points.ndim == 1


def _refuse(i: int, is_finite: bool):
    what = "has a coordinate beyond 2^300, the most that a mesh may have" if is_finite else "is not finite"
    raise ValueError(f"points: point {i} {what}")


def _bound_on_host(points, device) -> tuple:
    """Return points as an array of the device, and what `bound_point_kernel` finds; raise ValueError for bad ones."""
    points = to_numpy(points, "points")
    if points.shape == (0,):
        points = np.empty((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: shape {points.shape} and type {points.dtype}, not numbers of shape (n, 3)")
    points = np.ascontiguousarray(points, np.float64)
    if not np.abs(points).max(initial=0.0) <= COORDINATE_MAX:
        finite, near = np.isfinite(points).all(1), (np.abs(points) <= COORDINATE_MAX).all(1)
        _refuse(near.argmin() if finite.all() else finite.argmin(), finite.all())
    # NumPy takes ten times as long along the first axis.
    corners = np.array([(column.min(), column.max()) for column in points.T]) if len(points) else np.zeros((3, 2))
    bounds = wp.array([*corners.T.ravel(), np.inf], dtype=wp.float64, device=device)
    return wp.array(points, dtype=wp.vec3d, device=device), bounds


def _bound_on_gpu(points: wp.array) -> tuple:
    """Return the same of points that are there, without a look at them."""
    device: Any = points.device
    bounds = wp.clone(_no_bounds(device.alias))
    inputs = [BOUND_THREADS, wp.float64(COORDINATE_MAX), points, bounds]
    wp.launch(kernels.bound_point_kernel, BOUND_THREADS, inputs, device=points.device)
    return points, bounds


def _check_on_gpu(points: wp.array, bounds: wp.array):
    """Raise ValueError for the first bad point. Waits for the device."""
    first = bounds.numpy()[6]
    if np.isfinite(first):
        bad = int(first)
        _refuse(bad, np.isfinite(points[bad : bad + 1].numpy()).all())


def _sort(rows: wp.array, bounds: wp.array) -> wp.array:
    """Return indices of points along a Morton curve through their box."""
    code, order = (wp.empty(2 * len(rows), dtype=wp.int32, device=rows.device) for _ in range(2))
    wp.launch(kernels.code_point_kernel, len(rows), [bounds, rows, code, order], device=rows.device)
    radix_sort(code, order, len(rows), 3 * int(kernels.CODE_BITS))
    return order


def _find_batch(model, lod, device) -> Batch:
    """Return the batch of one object at an LOD, which is kept while its model lives, or three others are asked."""
    scene = PosedObjects(device)
    check_device(scene.device, "ab.signed_distance")
    key = id(model), lod, scene.device.alias
    kept = _kept.pop(key, None)
    if kept is None:
        scene.add(model, lod=lod)
        # Not the scene, which holds its models.
        kept = scene.batch(), weakref.ref(model, lambda _: _kept.pop(key, None))
    _kept[key] = kept
    for old in list(_kept)[:-KEPT_MODELS]:
        _kept.pop(old, None)
    return kept[0]
