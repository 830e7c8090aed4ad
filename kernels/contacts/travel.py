"""Travel, an estimate: the motion along the mean normal of its contacts that frees an object."""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees, load_vertex
from warp_abtree.kernels.base.lanes import warp_lane, warp_max, warp_size
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.contacts.contact import Contacts, PairObjects, have_crossed

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Squared sine of the angle between two planes, under which their line runs away too fast to tell how fast.
LEAST_SINE_SQUARED = wp.constant(wp.float64(2.0**-40))


@wp.func
def box_support(trees: Trees, i: wp.int32, n: wp.vec3d, origin: wp.vec3d):
    """Return the support of a posed object's root box along n from a point, world frame."""
    state = trees.objects.state[i]
    root = load_node(trees.states, trees.states.node_start[state] + 1)
    lower = wp.vec3d(root.lower)
    upper = wp.vec3d(root.upper)
    centre = pose_point(
        trees.objects.rotation[i], trees.objects.position[i], trees.models.centre[trees.states.model[state]]
    )
    m = wp.transpose(trees.objects.rotation[i]) * n
    reach = wp.dot(n, centre - origin)
    for k in range(3):
        reach += wp.max(m[k] * lower[k], m[k] * upper[k])
    return reach


@wp.func
def loop_change(segment: wp.vec3d, normal_a: wp.vec3d, normal_b: wp.vec3d, n: wp.vec3d):
    """Return a segment's part of the rate of change of the area within a contact curve, as B moves along n.

    The line of the two planes moves at v = x normal_a + y normal_b with v . normal_a = 0, v . normal_b = n . normal_b.
    """
    cosine = wp.dot(normal_a, normal_b)
    square = wp.float64(1.0) - cosine * cosine
    if square < LEAST_SINE_SQUARED:
        return wp.float64(0.0)
    y = wp.dot(n, normal_b) / square
    return y * wp.dot(normal_b - normal_a * cosine, wp.cross(segment, n))


@wp.func
def reach_faces(trees: Trees, own: PairObjects, pose: PairPose, face: wp.vec3i, n: wp.vec3d, origin: wp.vec3d):
    """Return the supports of the first object's face along n from a point, and of the second's against it."""
    a = trees.states.face_corner[pose.corner_a + face[1 + own.swapped]]
    b = trees.states.face_corner[pose.corner_b + face[2 - own.swapped]]
    front = -wp.float64(wp.inf)
    back = -wp.float64(wp.inf)
    for i in range(3):
        corner_a = load_vertex(trees.models.vertex_pos, a[i])
        corner_b = pose_point(pose.rotation, pose.translation, load_vertex(trees.models.vertex_pos, b[i]))
        reach_a = wp.dot(n, pose_point(trees.objects.rotation[own.a], trees.objects.position[own.a], corner_a) - origin)
        reach_b = wp.dot(n, pose_point(trees.objects.rotation[own.a], trees.objects.position[own.a], corner_b) - origin)
        # The normal goes from the object that the pair names first.
        front = wp.max(front, wp.where(own.swapped == 0, reach_a, reach_b))
        back = wp.max(back, -wp.where(own.swapped == 0, reach_b, reach_a))
    return front, back


@wp.func
def reach_contacts(
    trees: Trees,
    own: PairObjects,
    pose: PairPose,
    span: wp.vec3i,
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    n: wp.vec3d,
    origin: wp.vec3d,
):
    """Return `reach_faces` of all contacts of a span, for all lanes of a warp."""
    front = -wp.float64(wp.inf)
    back = -wp.float64(wp.inf)
    k = span[1] + warp_lane()
    while k < span[2]:
        if have_crossed(contacts, k):
            ahead, behind = reach_faces(trees, own, pose, faces[k], n, origin)
            front = wp.max(front, ahead)
            back = wp.max(back, behind)
        k += warp_size()
    return warp_max(front), -warp_max(back)


@wp.func
def choose_travel(
    trees: Trees,
    pair: wp.vec2i,
    n: wp.vec3d,
    origin: wp.vec3d,
    area: wp.float64,
    change: wp.float64,
    overlap: wp.float64,
):
    """Return the travel of a pair, `overlap` that of its faces where there is no area."""
    travel = box_support(trees, pair[0], n, origin)
    travel += box_support(trees, pair[1], -n, origin)
    if area == wp.float64(0.0):
        travel = wp.min(travel, overlap)
    elif area * change < wp.float64(0.0):
        travel = wp.min(travel, -area / change)
    return wp.max(travel, wp.float64(0.0))
