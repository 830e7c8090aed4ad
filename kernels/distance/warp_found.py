"""Upper bounds and nearest faces shared by all warps that search an object pair, by atomics."""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# Components of `Found.upper`.
UPPER, SLABS_PAY = wp.constant(0), wp.constant(1)


@native.func_native()
def load_upper(upper: wp.array(dtype=wp.vec2), i: wp.int32) -> wp.vec2:
    """Return an entry that other warps write, past the first-level cache; the same in all lanes."""


@native.func_native()
def lower_upper(upper: wp.array(dtype=wp.vec2), i: wp.int32, k: wp.int32, x: wp.float32):
    """Put in a number, 0 or more, as component k if it is lower."""


@native.func_native()
def load_distance(distance: wp.array(dtype=wp.float64), i: wp.int32) -> wp.float64: ...


@native.func_native()
def load_faces(faces: wp.array(dtype=wp.int64), i: wp.int32) -> wp.int64: ...


@native.func_native()
def offer_nearest(
    distance: wp.array(dtype=wp.float64), faces: wp.array(dtype=wp.int64), i: wp.int32, d: wp.float64, item: wp.int64
):
    """Put in faces that are nearer than those there, or as near and lower."""
