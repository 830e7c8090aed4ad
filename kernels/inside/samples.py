"""Depth samples of a surface inside a solid: their places on a face, depths, and directions out.

Samples of a face are its corners, the middles of its edges and its centroid. The depth of a point inside is its
distance from the surface.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import HALF, PairPose
from warp_abtree.kernels.inside.nearest_face import (
    NO_NEAREST,
    Solid,
    into_frame,
    nearest_face,
    point_distance,
    point_features,
    point_weights,
    square_outside,
)
from warp_abtree.kernels.inside.parity import is_inside, load_posed_face

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points of a face that are looked at.
SAMPLES = wp.constant(7)
NO_SAMPLE = wp.constant(wp.int64(2**63 - 1))
# Before all samples: of what is known already, equally deep ones are no better.
KNOWN = wp.constant(wp.int64(-1))
AVOIDED_MAX = wp.constant(3)


@wp.struct
class Deepest:
    """The deepest sample found so far."""

    depth: wp.float64  # [model units], 0 for none
    item: wp.int64  # see `pack_deepest`
    of_b: bool  # whether it is of B, inside A


@wp.struct
class Sampling:
    """Selection of samples: the first ones of each face, not near points to avoid, their ways out along a direction."""

    samples: wp.int32  # of each face: 3, its corners, or SAMPLES
    way: wp.vec3d  # B's way out, in A's frame: others make an angle of at most 90 degrees with it; 0 for any
    count: wp.int32  # points to avoid, AVOIDED_MAX at most
    radius: wp.float64  # what is near to them [model units]
    first: wp.vec3d  # point to avoid, in A's frame
    second: wp.vec3d  # point to avoid, in A's frame
    third: wp.vec3d  # point to avoid, in A's frame


@wp.func
def is_avoided(sampling: Sampling, point: wp.vec3d, reach: wp.float64):
    """Return whether all that lies within a reach of a point is near to one of the points to avoid."""
    near = bool(False)
    if sampling.count > 0:
        near = wp.length(point - sampling.first) + reach < sampling.radius
    if sampling.count > 1:
        near = near or wp.length(point - sampling.second) + reach < sampling.radius
    if sampling.count > 2:
        near = near or wp.length(point - sampling.third) + reach < sampling.radius
    return near


@wp.func
def pack_deepest(face: wp.int32, sample: wp.int32, nearest: wp.int32):
    """Return the item of a sample and the face that is nearest; the lowest of several that are equally deep counts:

    63 62                        33 32    30 29                         0
    [0|       face of the sample    | sample |      face that is nearest   ]
    """
    return (wp.int64(face) << wp.int64(33)) | (wp.int64(sample) << wp.int64(30)) | wp.int64(nearest)


@wp.func
def sample_weights(sample: wp.int32):
    """Return the weights of a face's corners at a sample: corners, middles of the edges behind them, the centroid."""
    w = wp.vec3d()
    if sample == SAMPLES - 1:
        third = wp.float64(1.0) / wp.float64(3.0)
        return wp.vec3d(third, third, third)
    k = sample % 3
    w[k] = wp.where(sample < 3, wp.float64(1.0), HALF)
    if sample >= 3:
        w[(k + 1) % 3] = HALF
    return w


@wp.func
def way_out(trees: Trees, pose: PairPose, outer: Solid, face: wp.int32, point: wp.vec3d):
    """Return the way from a point to the nearest one of a face of an object, in A's frame."""
    a, b, c = load_posed_face(trees, pose, outer.of_b, face)
    near, _size = point_features(a, b, c, point)
    w = point_weights(near)
    return w[0] * (a - point) + w[1] * (b - point) + w[2] * (c - point)


@wp.func
def measure_samples(
    trees: Trees,
    pose: PairPose,
    inner: Solid,
    outer: Solid,
    face: wp.int32,
    hint: wp.int32,
    known: Deepest,
    sampling: Sampling,
):
    """Return the deepest of a known sample and the samples of a face that are inside the outer object."""
    best = known
    a, b, c = load_posed_face(trees, pose, inner.of_b, face)
    centre = wp.where(inner.of_b, outer.centre, inner.centre)
    root = load_node(trees.states, outer.node + 1)
    near = wp.int32(hint)
    k = wp.int32(0)
    while k < sampling.samples:
        w = sample_weights(k)
        point = (w[0] * a + w[1] * b) + w[2] * c
        met = square_outside(root, into_frame(pose, outer, point)) <= outer.margin * outer.margin
        if met and not is_avoided(sampling, point, wp.float64(0.0)):
            hopeful = bool(True)
            if near != NO_NEAREST:
                hopeful = point_distance(trees, pose, outer, near, point) >= best.depth
            if hopeful and is_inside(trees, pose, outer.of_b, centre, point):
                distance, near = nearest_face(trees, pose, outer, point, near, best.depth)
                if distance >= best.depth and distance > wp.float64(0.0):
                    item = pack_deepest(face, k, near)
                    if distance > best.depth or item < best.item:
                        way = way_out(trees, pose, outer, near, point)
                        if wp.dot(way, wp.where(inner.of_b, sampling.way, -sampling.way)) >= wp.float64(0.0):
                            best.depth = distance
                            best.item = item
        k += 1
    return best
