"""Upper bounds and nearest faces shared by all warps that search an object pair, by atomics."""

import functools

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

faces_code = functools.partial(native.body, "distance/warp_found.cuh")


# Components of `Found.upper`.
UPPER, SLABS_PAY = wp.constant(0), wp.constant(1)


@wp.func_native(faces_code("load_upper"))
def load_upper(upper: wp.array(dtype=wp.vec2), i: wp.int32) -> wp.vec2:
    """Return an entry that other warps write, past the first-level cache; the same in all lanes."""


@wp.func_native(faces_code("lower_upper"))
def lower_upper(upper: wp.array(dtype=wp.vec2), i: wp.int32, k: wp.int32, x: wp.float32):
    """Put in a number, 0 or more, as component k if it is lower."""


@wp.func_native(faces_code("load_distance"))
def load_distance(distance: wp.array(dtype=wp.float64), i: wp.int32) -> wp.float64: ...


@wp.func_native(faces_code("load_faces"))
def load_faces(faces: wp.array(dtype=wp.int64), i: wp.int32) -> wp.int64: ...


@wp.func_native(faces_code("offer_nearest"))
def offer_nearest(
    distance: wp.array(dtype=wp.float64), faces: wp.array(dtype=wp.int64), i: wp.int32, d: wp.float64, item: wp.int64
):
    """Put in faces that are nearer than those there, or as near and lower."""
