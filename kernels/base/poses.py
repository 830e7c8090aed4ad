"""Poses of objects, and the pose of one object in the frame of another, with margins that cover all rounding.

The margin of boxes covers every rounding between the exact x' of B's vertices and the float32 box test, its float64
part x' itself and the shift between centres, and `skew` a rotation that is not orthonormal to the last bit, on whose
columns B's axes are taken: docs/exactness.md, bounds 7, 8 and 9. A gap along a unit axis is a distance, so `within`
adds to the margin; a column is longer than 1 by at most `skew`.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.nodes import load_node

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Products of three coordinates stay normal above this; smaller ones are 0.
COORDINATE_MIN = wp.constant(wp.float64(2.0**-290))
ROUNDING_32 = wp.constant(wp.float64(9.0 * 2.0**-24))
UNIT_32 = wp.constant(wp.float64(2.0**-24))
# Between these sizes of models float32 neither overflows nor loses digits to underflow.
REACH_MIN = wp.constant(wp.float64(2.0**-100))
REACH_MAX = wp.constant(wp.float64(2.0**100))
# Objects farther apart are not compared in float32, whose greatest number is hardly more than what is added up of this.
FAR_MAX = wp.constant(wp.float64(2.0**125))
# Some ten float64 roundings; this is 32 of them.
ROUNDING_64 = wp.constant(wp.float64(2.0**-48))
# Of what brings small sizes to about 1.
SCALE_MAX = wp.constant(wp.float64(2.0**100))
HALF = wp.constant(wp.float64(0.5))
# Nodes so few levels above the leaves have slabs: of 8 faces at most at the finest LOD, at others more levels.
SLAB_DEPTH = wp.constant(3)
NO_NODE = wp.constant(2**31 - 1)
# Slabs separate little where boxes are hardly wider along their directions: by so many 64ths of the sum of widths.
SLAB_GAIN_UNIT, SLAB_GAIN_LEAST = wp.constant(64), wp.constant(16)


@wp.struct
class PairPose:
    """The pose of B in A's frame, A the object with the smaller index.

    In this order nothing is padded, which would be stored byte by byte.
    """

    rotation: wp.mat33d  # B's model frame to A's
    translation: wp.vec3d  # B's model frame to A's
    rotation32: wp.mat33  # coordinates of B about its model's centre to those of A about its own; the transpose back
    translation32: wp.vec3  # the same, of B to A
    back32: wp.vec3  # the same, of A to B
    margin: wp.float32  # that boxes are widened by
    error: wp.float32  # of a coordinate of `float32_filter_triangles`, twice
    swapped: wp.int32  # 1 where the pair names B first
    scale: wp.float64  # power of two that brings the larger model to about unit size
    within: wp.float64  # distance that `margin` covers too, 0 for intersection
    node_a: wp.int32  # where A's tree lies in the pool
    node_b: wp.int32  # where B's tree lies in the pool
    corner_a: wp.int32  # where A's face corners lie in the pool
    corner_b: wp.int32  # where B's face corners lie in the pool
    slab: wp.vec2i  # where slabs of A's nodes lie in the models' pool, and of B's
    floor: wp.vec2i  # nodes of A, and of B, from these on have slabs; none where either model has none
    faces_a: wp.int32  # about how many faces A has at its LOD, no more than at the finest
    faces_b: wp.int32  # the same of B


@wp.struct
class PairBatch:
    """The object pairs of a launch."""

    count: wp.array(dtype=wp.int32)  # of pairs, perhaps more than there is room for, shape [1]
    pairs: wp.array(dtype=wp.vec2i)  # objects, shape [pair]
    poses: wp.array(dtype=PairPose)  # of B in A's frame, shape [pair]
    launched: wp.array(dtype=wp.int32)  # what became of the launch, see `generation.LaunchRecord`, shape [2]


@wp.func
def sum_products(p0: wp.float64, q0: wp.float64, p1: wp.float64, q1: wp.float64, p2: wp.float64, q2: wp.float64):
    return (p0 * q0 + p1 * q1) + p2 * q2


@wp.func
def pose_point(rotation: wp.mat33d, translation: wp.vec3d, p: wp.vec3d):
    """Return x' of docs/exactness.md: left to right, without fused multiply-add, tiny coordinates as 0."""
    x = wp.vec3d()
    for i in range(3):
        y = sum_products(rotation[i, 0], p[0], rotation[i, 1], p[1], rotation[i, 2], p[2]) + translation[i]
        x[i] = wp.where(wp.abs(y) < COORDINATE_MIN, wp.float64(0.0), y)
    return x


@wp.func
def relative_pose(objects: ObjectPool, a: wp.int32, b: wp.int32):
    """Return R = Ra^T Rb and t = Ra^T (tb - ta), each entry the sum of its three products from left to right."""
    ra = objects.rotation[a]
    rb = objects.rotation[b]
    shift = objects.position[b] - objects.position[a]
    r = wp.mat33d()
    t = wp.vec3d()
    for i in range(3):
        t[i] = sum_products(ra[0, i], shift[0], ra[1, i], shift[1], ra[2, i], shift[2])
        for j in range(3):
            r[i, j] = sum_products(ra[0, i], rb[0, j], ra[1, i], rb[1, j], ra[2, i], rb[2, j])
    return r, t


@wp.func
def reach_box(lower: wp.vec3, upper: wp.vec3):
    """Return the largest coordinate of a box, in magnitude."""
    m = wp.max(wp.max(wp.abs(lower[0]), wp.abs(upper[0])), wp.max(wp.abs(lower[1]), wp.abs(upper[1])))
    return wp.float64(wp.max(m, wp.max(wp.abs(lower[2]), wp.abs(upper[2]))))


@wp.func
def measure_rotation(r: wp.mat33d):
    """Return the largest entries of |R^T R - 1| and |R - 1|."""
    skew = wp.float64(0.0)
    size = wp.float64(0.0)
    for i in range(3):
        for j in range(3):
            one = wp.where(i == j, wp.float64(1.0), wp.float64(0.0))
            gram = sum_products(r[0, i], r[0, j], r[1, i], r[1, j], r[2, i], r[2, j])
            skew = wp.max(skew, wp.abs(gram - one))
            size = wp.max(size, wp.abs(r[i, j] - one))
    return skew, size


@wp.func
def unit_scale(reach: wp.float64):
    """Return the power of two that brings a size to about 1: the exponent of a float32 without its digits."""
    exponent = wp.cast(wp.float32(reach), wp.int32) & 0x7F800000
    return wp.float64(1.0) / wp.float64(wp.cast(exponent, wp.float32))


@wp.func
def find_node_slabs(trees: Trees, state: wp.int32, within: wp.float64):
    """Return where slabs of a state's nodes lie, at its LOD, and the first node that has one; NO_NODE where there are
    none, or they gain little: at other LODs than the finest where nothing nearer than a distance is asked for."""
    model = trees.states.model[state]
    start, entry, none = wp.int32(trees.models.node_start[model]), wp.int32(model), bool(False)
    if trees.states.lod[state] != trees.models.lod_max[model]:
        none = within == wp.float64(0.0) or trees.states.lod[state] != trees.models.slab_lod[model]
        start += trees.models.node_slab.shape[0] / 2
        entry += trees.models.depth.shape[0]
    gain = trees.models.slab_gain[entry]
    if none or trees.models.node_slab.shape[0] == 0 or gain[0] <= SLAB_GAIN_LEAST * gain[1]:
        return wp.vec2i(start, NO_NODE)
    return wp.vec2i(start, trees.models.slab_first[entry])


@wp.func
def active_faces(trees: Trees, state: wp.int32):
    """Estimate the number of faces of a state: a vertex split of a closed manifold adds two."""
    model = trees.states.model[state]
    return trees.models.face_count[model] - 2 * (trees.models.lod_max[model] - trees.states.lod[state])


@wp.func
def place_trees(trees: Trees, state_a: wp.int32, state_b: wp.int32, within: wp.float64):
    """Return a `PairPose` with the places of the trees in the pool, and no more."""
    pose = PairPose()
    pose.node_a = trees.states.node_start[state_a]
    pose.node_b = trees.states.node_start[state_b]
    pose.corner_a = trees.states.face_start[state_a]
    pose.corner_b = trees.states.face_start[state_b]
    pose.faces_a = active_faces(trees, state_a)
    pose.faces_b = active_faces(trees, state_b)
    slabs_a, slabs_b = find_node_slabs(trees, state_a, within), find_node_slabs(trees, state_b, within)
    pose.slab = wp.vec2i(slabs_a[0], slabs_b[0])
    pose.floor = wp.vec2i(slabs_a[1], slabs_b[1])
    if slabs_a[1] == NO_NODE or slabs_b[1] == NO_NODE:
        pose.floor = wp.vec2i(NO_NODE, NO_NODE)
    return pose


@wp.func
def pair_pose(whole: bool, trees: Trees, a: wp.int32, b: wp.int32, within: wp.float64):
    """Return the `PairPose` of B in A's frame, for points that meet or lie within a distance in A's frame.

    `whole` says that all faces are asked for, not one hit, which float32 may find first.
    """
    r, t = relative_pose(trees.objects, a, b)
    state_a = trees.objects.state[a]
    state_b = trees.objects.state[b]
    centre_a = trees.models.centre[trees.states.model[state_a]]
    centre_b = trees.models.centre[trees.states.model[state_b]]
    root_a = load_node(trees.states, trees.states.node_start[state_a] + 1)
    root_b = load_node(trees.states, trees.states.node_start[state_b] + 1)
    reach_a = reach_box(root_a.lower, root_a.upper)
    reach_b = reach_box(root_b.lower, root_b.upper)
    shift = wp.vec3d()
    size = wp.float64(0.0)
    far = wp.float64(0.0)
    for i in range(3):
        shift[i] = (sum_products(r[i, 0], centre_b[0], r[i, 1], centre_b[1], r[i, 2], centre_b[2]) + t[i]) - centre_a[i]
        far = wp.max(far, wp.abs(shift[i]))
        size = wp.max(size, wp.abs(t[i]) + wp.abs(centre_a[i]))
    skew, rotation_size = measure_rotation(r)
    reach_c = wp.max(wp.max(wp.abs(centre_b[0]), wp.abs(centre_b[1])), wp.abs(centre_b[2]))
    margin64 = ROUNDING_64 * (size + wp.float64(2.0) * (reach_c + reach_b) + reach_a)
    margin64 = margin64 + wp.float64(4.0) * skew * (reach_b + far)
    margin32 = ROUNDING_32 * (reach_a + reach_b + far)
    # Of a coordinate in `float32_filter_triangles`: docs/exactness.md, bound 1, whose terms need `near` below.
    off32 = UNIT_32 * (wp.float64(2.0) * reach_a + wp.float64(13.0) * reach_b + wp.float64(3.0) * far)

    pose = place_trees(trees, state_a, state_b, within)
    pose.rotation = r
    pose.translation = t
    pose.within = within
    pose.rotation32 = wp.mat33(r)
    pose.scale = unit_scale(wp.max(reach_a, reach_b))
    pose.error = wp.float32(pose.scale * wp.float64(2.02) * (off32 + margin64))
    if wp.max(reach_a, reach_b) < REACH_MIN or wp.max(reach_a, reach_b) > REACH_MAX:
        pose.error = wp.inf
    same = trees.states.model[state_a] == trees.states.model[state_b]
    same = same and trees.states.lod[state_a] == trees.states.lod[state_b]
    if whole and same and far + wp.float64(3.0) * rotation_size * reach_b <= off32:
        # Coincident meshes: no vertex is farther from its twin than float32 can tell.
        pose.error = wp.inf
    # A margin that no box passes, for pairs that are apart for certain and perhaps beyond float32, or even float64: a
    # distance that overflowed gives infinity or NaN.
    pose.margin = -wp.inf
    limit = wp.float64(2.0) * (reach_a + wp.float64(2.0) * reach_b) + margin64
    wide = limit + within
    near = wp.abs(shift[0]) <= wide and wp.abs(shift[1]) <= wide and wp.abs(shift[2]) <= wide
    if near and far > FAR_MAX:
        # Within a distance as long: nothing in float32 tells them apart.
        pose.error = wp.inf
        pose.margin = wp.inf
    elif near and limit < wp.float64(wp.inf):
        pose.translation32 = wp.vec3(shift)
        for i in range(3):
            pose.back32[i] = -wp.float32(sum_products(r[0, i], shift[0], r[1, i], shift[1], r[2, i], shift[2]))
        pose.margin = wp.float32(margin64 + margin32 + within * (wp.float64(1.0) + skew + ROUNDING_32))
    return pose


@wp.func
def unit_quaternion_matrix(x: wp.float64, y: wp.float64, z: wp.float64, w: wp.float64):
    """Return the rotation matrix of a unit quaternion."""
    two = wp.float64(2.0)
    one = wp.float64(1.0)
    return wp.mat33d(
        one - two * (y * y + z * z),
        two * (x * y - z * w),
        two * (x * z + y * w),
        two * (x * y + z * w),
        one - two * (x * x + z * z),
        two * (y * z - x * w),
        two * (x * z - y * w),
        two * (y * z + x * w),
        one - two * (x * x + y * y),
    )


@wp.func
def rotate_quaternion(q: wp.vec4d):
    """Return the rotation matrix of a quaternion x y z w after normalising it."""
    norm = wp.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    return unit_quaternion_matrix(q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


@wp.func
def measure_skew(r: wp.mat33d):
    """Return how far R R^T is off the identity, the largest entry; a matrix is off by 3 times that at most."""
    gram = r * wp.transpose(r)
    skew = wp.float64(0.0)
    for i in range(3):
        for j in range(3):
            skew = wp.max(skew, wp.abs(gram[i, j] - wp.where(i == j, wp.float64(1.0), wp.float64(0.0))))
    return skew
