"""Even-odd ray test, exact: a point is inside a closed surface that a ray from it crosses an odd number of times.

Coordinates are those of the intersection test: A's vertices, and x' of B's (docs/exactness.md). The ray starts at the
point moved by (e, e^2) across the axis, e positive and smaller than any number, and never meets an edge then: of a
coordinate that is equal the point's is the greater, and a point on the line of an edge lies where the first coordinate
grows. A point off the surface stays on its side of it. A face is crossed where the ray's line passes through its
projection, which signs of `orient2d` decide, and its plane lies ahead, one sign of `orient3d`: not 0, or the point
would lie on the face. Both faces of an edge see the same signs, so numbers of crossings add up whatever is degenerate.

Source of the perturbation: Edelsbrunner and Muecke 1990, Simulation of simplicity.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import StatePool, Trees, load_vertex
from warp_abtree.kernels.base.boxes import pose_box
from warp_abtree.kernels.base.nodes import Node, load_node
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.exact.predicates import EXACT, drop_axis, orient2d, orient3d

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Nodes that wait: at most one a level, and the last two.
STACK_ROOM = wp.constant(40)


@wp.struct
class Ray:
    """A point, and the axis of A's frame along which a ray leaves it."""

    origin: wp.vec3d  # in A's frame
    near: wp.vec3d  # the same about the centre of A's model, as boxes are
    axis: wp.int32  # 0, 1 or 2
    ahead: wp.int32  # 1 or -1


@wp.func
def side_of_edge(p: wp.vec2d, u: wp.vec2d, v: wp.vec2d):
    """Return 0 where the edge does not cross the line from p along the first coordinate, else 1 upwards, -1 down."""
    rises = v[1] > p[1]
    if (u[1] > p[1]) == rises:
        return 0
    if p[0] >= wp.max(u[0], v[0]):
        return 0
    sign = wp.where(rises, 1, -1)
    if p[0] < wp.min(u[0], v[0]):
        return sign
    return wp.where(orient2d(EXACT, u, v, p) == sign, sign, 0)


@wp.func
def crosses_face(ray: Ray, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return whether a ray crosses a face, 1 or 0."""
    k = ray.axis
    height = ray.origin[k]
    low = wp.min(wp.min(a[k], b[k]), c[k])
    high = wp.max(wp.max(a[k], b[k]), c[k])
    if (ray.ahead > 0 and high < height) or (ray.ahead < 0 and low > height):
        return 0
    p = drop_axis(ray.origin, k)
    a2, b2, c2 = drop_axis(a, k), drop_axis(b, k), drop_axis(c, k)
    # Of a face around the point one edge passes it on the far side, upwards where the face turns counterclockwise.
    turn = side_of_edge(p, a2, b2) + side_of_edge(p, b2, c2) + side_of_edge(p, c2, a2)
    if turn == 0:
        return 0
    if (ray.ahead > 0 and low > height) or (ray.ahead < 0 and high < height):
        return 1
    return wp.where(orient3d(EXACT, a, b, c, ray.origin) * turn == ray.ahead, 1, 0)


@wp.func
def ray_meets(ray: Ray, sum: wp.vec3, size: wp.vec3):
    """Return False only where a ray misses a box: twice its centre, and its width, about the centre of A's model."""
    met = bool(True)
    for i in range(3):
        x = wp.float64(2.0) * ray.near[i] - wp.float64(sum[i])
        reach = wp.float64(size[i])
        if i == ray.axis:
            x = wp.where(ray.ahead > 0, wp.max(x, wp.float64(0.0)), wp.min(x, wp.float64(0.0)))
        if not wp.abs(x) <= reach:
            met = False
    return met


@wp.func
def meets_node(pose: PairPose, of_b: bool, node: Node, ray: Ray):
    """Return False only where a ray meets no face below a node of A, or of B."""
    if node.skip < 0:
        return False
    if not of_b:
        met = bool(True)
        for i in range(3):
            lower = wp.float64(node.lower[i])
            upper = wp.float64(node.upper[i])
            x = ray.near[i]
            below = x < lower and not (i == ray.axis and ray.ahead > 0)
            above = x > upper and not (i == ray.axis and ray.ahead < 0)
            if below or above:
                met = False
        return met
    box = pose_box(node.lower, node.upper, pose.rotation32, pose.translation32, pose.margin)
    return ray_meets(ray, box.posed_sum, box.posed_size)


@wp.func
def make_ray(pose: PairPose, of_b: bool, states: StatePool, centre: wp.vec3d, point: wp.vec3d):
    """Return the axis-aligned ray from a point in A's frame that leaves a tree's box soonest."""
    ray = Ray()
    ray.origin = point
    ray.near = point - centre
    root = load_node(states, wp.where(of_b, pose.node_b, pose.node_a) + 1)
    middle, half = root.upper + root.lower, root.upper - root.lower
    if of_b:
        box = pose_box(root.lower, root.upper, pose.rotation32, pose.translation32, pose.margin)
        middle = wp.vec3(box.posed_sum)
        half = wp.vec3(box.posed_size)
    least = wp.float32(wp.inf)
    ray.ahead = 1
    for i in range(3):
        x = wp.float32(2.0) * wp.float32(ray.near[i]) - middle[i]
        way = half[i] - wp.abs(x)
        if way < least:
            least = way
            ray.axis = i
            ray.ahead = wp.where(x < 0.0, -1, 1)
    return ray


@wp.func
def load_posed_face(trees: Trees, pose: PairPose, of_b: bool, face: wp.int32):
    """Return the corners of an active face of A or of B in A's frame."""
    c = trees.states.face_corner[wp.where(of_b, pose.corner_b, pose.corner_a) + face]
    p = load_vertex(trees.models.vertex_pos, c[0])
    q = load_vertex(trees.models.vertex_pos, c[1])
    r = load_vertex(trees.models.vertex_pos, c[2])
    if of_b:
        p = pose_point(pose.rotation, pose.translation, p)
        q = pose_point(pose.rotation, pose.translation, q)
        r = pose_point(pose.rotation, pose.translation, r)
    return p, q, r


@wp.func
def is_inside(trees: Trees, pose: PairPose, of_b: bool, centre: wp.vec3d, point: wp.vec3d):
    """Return whether a point in A's frame, off the surface, is inside the closed surface of A, or of B.

    Args:
        centre: Of A's model.
    """
    ray = make_ray(pose, of_b, trees.states, centre, point)
    start = wp.where(of_b, pose.node_b, pose.node_a)
    stack = wp.zeros(shape=(STACK_ROOM,), dtype=wp.int32)
    crossings = wp.int32(0)
    end = wp.int32(0)
    if meets_node(pose, of_b, load_node(trees.states, start + 1), ray):
        stack[0] = 1
        end = 1
    while end > 0:
        end -= 1
        node = load_node(trees.states, start + stack[end])
        if node.face >= 0:
            a, b, c = load_posed_face(trees, pose, of_b, node.face)
            crossings += crosses_face(ray, a, b, c)
        else:
            for k in range(2):
                child = 2 * node.skip + k
                if meets_node(pose, of_b, load_node(trees.states, start + child), ray):
                    stack[end] = child
                    end += 1
    return (crossings & 1) != 0
