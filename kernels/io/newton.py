"""Poses of objects from those of Newton's bodies, and `newton.Contacts` from contact points."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.poses import PairBatch, rotate_quaternion
from warp_abtree.kernels.contacts.manifold import Manifolds

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class RigidContacts:
    """Rigid contacts of `newton.Contacts` as its solvers read them; shape [rigid_contact_max] except count."""

    count: wp.array(dtype=wp.int32)  # [1], contacts
    shape0: wp.array(dtype=wp.int32)  # first shape of each contact
    shape1: wp.array(dtype=wp.int32)  # second shape
    point0: wp.array(dtype=wp.vec3)  # contact point of shape 0 [m], body frame
    point1: wp.array(dtype=wp.vec3)  # contact point of shape 1 [m], body frame
    offset0: wp.array(dtype=wp.vec3)  # from point0 to the surface with margin [m], body frame
    offset1: wp.array(dtype=wp.vec3)  # from point1 to the surface with margin [m], body frame
    normal: wp.array(dtype=wp.vec3)  # unit, from shape 0 to shape 1, world
    margin0: wp.array(dtype=wp.float32)  # surface margin of shape 0 [m]
    margin1: wp.array(dtype=wp.float32)  # surface margin of shape 1 [m]


@wp.struct
class ShapeSettings:
    """Settings of shapes as of `newton.Model`, shape [shape_count]."""

    type: wp.array(dtype=wp.int32)  # newton.GeoType
    scale: wp.array(dtype=wp.vec3)  # along the axes of the shape's frame
    margin: wp.array(dtype=wp.float32)  # surface margin [m]
    gap: wp.array(dtype=wp.float32)  # how far beyond the margin contacts begin [m]
    flags: wp.array(dtype=wp.int32)  # newton.ShapeFlags
    collision_group: wp.array(dtype=wp.int32)  # 0 collides with none
    world: wp.array(dtype=wp.int32)  # -1 is in every one
    body: wp.array(dtype=wp.int32)  # -1 is static


@wp.kernel
def find_changed_kernel(
    collides: wp.int32,
    is_own: wp.array(dtype=wp.int32),
    kept: ShapeSettings,
    now: ShapeSettings,
    changed_out: wp.array(dtype=wp.int32),
):
    """Find the first shape whose settings are others than were kept.

    Args:
        collides: Flags that count.
        is_own: Whether each shape is one of the scene's, whose geometry counts too.
        changed_out: The least such shape so far, shape [1].
    """
    s = wp.tid()
    same = ((kept.flags[s] ^ now.flags[s]) & collides) == 0 and kept.collision_group[s] == now.collision_group[s]
    same = same and kept.type[s] == now.type[s] and kept.world[s] == now.world[s] and kept.body[s] == now.body[s]
    if is_own[s] != 0:
        same = same and kept.scale[s] == now.scale[s]
        same = same and kept.margin[s] == now.margin[s] and kept.gap[s] == now.gap[s]
    if not same:
        wp.atomic_min(changed_out, 0, s)


@wp.func
def rotation_of(x: wp.transform):
    """Return the rotation matrix of a pose, its quaternion normalised in float64."""
    q = wp.transform_get_rotation(x)
    return rotate_quaternion(wp.vec4d(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.kernel
def pose_object_kernel(
    shapes: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    shape_body: wp.array(dtype=wp.int32),
    shape_transform: wp.array(dtype=wp.transform),
    objects_out: ObjectPool,
):
    """Put each object where its shape stands."""
    i = wp.tid()
    x = shape_transform[shapes[i]]
    body = shape_body[shapes[i]]
    if body >= 0:
        x = body_q[body] * x
    objects_out.position[i] = wp.vec3d(wp.transform_get_translation(x))
    objects_out.rotation[i] = rotation_of(x)


@wp.func
def enter_body(
    body_q: wp.array(dtype=wp.transform), shape_body: wp.array(dtype=wp.int32), shape: wp.int32, point: wp.vec3d
):
    """Return a point of the world in the frame of a shape's body."""
    if shape_body[shape] < 0:
        return wp.vec3(point)
    x = body_q[shape_body[shape]]
    return wp.vec3(wp.transpose(rotation_of(x)) * (point - wp.vec3d(wp.transform_get_translation(x))))


@wp.func
def turn_into_body(
    body_q: wp.array(dtype=wp.transform), shape_body: wp.array(dtype=wp.int32), shape: wp.int32, v: wp.vec3
):
    """Return a vector of the world in the frame of a shape's body."""
    if shape_body[shape] < 0:
        return v
    return wp.quat_rotate_inv(wp.transform_get_rotation(body_q[shape_body[shape]]), v)


@wp.kernel
def count_point_kernel(batch: PairBatch, manifolds: Manifolds, count_out: wp.array(dtype=wp.int32)):
    """Count the points of each pair in place, 0 behind the last."""
    p = wp.tid()
    count_out[p] = wp.where(p < batch.count[0], manifolds.count[p], 0)


@wp.kernel
def write_contact_kernel(
    first: wp.array(dtype=wp.int32),
    margin: wp.array(dtype=wp.float32),
    shapes: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    shape_body: wp.array(dtype=wp.int32),
    batch: PairBatch,
    manifolds: Manifolds,
    end: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    contacts_out: RigidContacts,
):
    """Write the points of one pair a thread: half the depth on either side of where the manifold has them.

    Args:
        first: Contacts that are there already, which stay, shape [1].
        margin: Surface margin of each shape [m].
        end: Sum of the counts of points up to and with each pair.
    """
    p = wp.tid()
    if p == batch.pairs.shape[0] - 1:
        contacts_out.count[0] = first[0] + end[p]
    shape0 = shapes[batch.pairs[p][0]]
    shape1 = shapes[batch.pairs[p][1]]
    k = wp.int32(0)
    while k < count[p]:
        at = first[0] + end[p] - count[p] + k
        if at < contacts_out.shape0.shape[0]:
            n = manifolds.normal[p, k]
            half = wp.float64(0.5) * manifolds.depth[p, k]
            x0 = manifolds.point[p, k] + n * half
            x1 = manifolds.point[p, k] - n * half
            normal = wp.vec3(n)
            contacts_out.shape0[at] = shape0
            contacts_out.shape1[at] = shape1
            contacts_out.point0[at] = enter_body(body_q, shape_body, shape0, x0)
            contacts_out.point1[at] = enter_body(body_q, shape_body, shape1, x1)
            contacts_out.offset0[at] = turn_into_body(body_q, shape_body, shape0, margin[shape0] * normal)
            contacts_out.offset1[at] = turn_into_body(body_q, shape_body, shape1, -margin[shape1] * normal)
            contacts_out.normal[at] = normal
            contacts_out.margin0[at] = margin[shape0]
            contacts_out.margin1[at] = margin[shape1]
        k += 1


@wp.struct
class Matching:
    """What tells which contacts are those of the launch before, where a buffer of Newton's asks for it."""

    row: wp.array(dtype=wp.int32)  # place of each pair among those of the launch before, -1 for none, shape [pair]
    start: wp.array(dtype=wp.int32)  # where the contacts of its pairs began, shape [pair]
    next_start: wp.array(dtype=wp.int32)  # where those of this launch begin, shape [pair]
    launches: wp.array(dtype=wp.int32)  # of the query, shape [1]
    written: wp.array(dtype=wp.int32)  # that number when contacts were written last, shape [1]
    generation: wp.array(dtype=wp.int32)  # of the buffer, before it was cleared, shape [1]
    written_generation: wp.array(dtype=wp.int32)  # of what was written last, shape [1]
    buffer: wp.array(dtype=wp.int64)  # address of what was written last, 0 for none, shape [1]


@wp.kernel
def match_contact_kernel(
    buffer: wp.int64,
    first: wp.array(dtype=wp.int32),
    batch: PairBatch,
    manifolds: Manifolds,
    end: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    matching_inout: Matching,
    index_out: wp.array(dtype=wp.int32),
    generation_out: wp.array(dtype=wp.int32),
):
    """Write which contact of the buffer's last contents each point of one pair a thread is, -1 for a new one.

    None is known where others have written or cleared the buffer since, or the query was launched in between.

    Args:
        buffer: Address of the contacts.
        first, end, count: As for `write_contact_kernel`.
        index_out, generation_out: The buffer's match indices, and the generation that they refer to, -1 for none.
    """
    p = wp.tid()
    start, known = first[0] + end[p] - count[p], matching_inout.buffer[0] == buffer
    known = known and matching_inout.generation[0] == matching_inout.written_generation[0]
    known = known and matching_inout.launches[0] == matching_inout.written[0] + 1
    matching_inout.next_start[p] = start
    if p == 0:
        generation_out[0] = wp.where(known, matching_inout.generation[0], -1)
    if p >= batch.count[0]:
        return
    row = matching_inout.row[p]
    for k in range(count[p]):
        before = wp.int32(-1)
        if known and row >= 0 and manifolds.before[p, k] >= 0:
            before = matching_inout.start[row] + manifolds.before[p, k]
        if start + k < index_out.shape[0]:
            index_out[start + k] = before


@wp.kernel
def keep_start_kernel(buffer: wp.int64, generation: wp.array(dtype=wp.int32), matching_inout: Matching):
    """Note where the contacts of each pair begin in a buffer, and its generation, for the next launch."""
    p = wp.tid()
    matching_inout.start[p] = matching_inout.next_start[p]
    if p == 0:
        matching_inout.buffer[0] = buffer
        matching_inout.written_generation[0] = generation[0]
        matching_inout.written[0] = matching_inout.launches[0]
