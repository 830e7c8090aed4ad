"""Contacts: where intersecting faces meet, with which normals, and one summary an object pair.

Everything is computed from the inputs of the exact test, in the frame of the object with the lower index, and then
posed to the world by that object's pose. A face pair's contact, in the order in which the pair names its objects:

* p0, p1: the ends of the segment that the two faces share, along normal_a x normal_b; where the faces are coplanar, the
  two points of the polygon that they share that are farthest apart; where they touch in a point, that point twice.
* normal_a, normal_b: unit normals of the faces by their winding, zero for faces of no area.
* normal: unit, from the first object to the second: the direction of normal_a - normal_b. Where that is shorter than
  2^-20, the faces look the same way, and it is the normal of the lower object's face, turned towards the higher; where
  neither face has an area, the direction from one model's centre to the other's, or the x axis.
* coplanar: whether the faces have area and lie in one plane, exactly.

An end is a corner, or lies on an edge, off its exact place by at most 2^-40 of the edge's length and the rounding of
coordinates in both frames. Pairs that a coarser precision reports although they are apart get a point between them.

An object pair's summary is a sum over its contacts in the order of `Result.faces`, in float64:

* count: contacts, as `Result.count`.
* point: mean of the segments' midpoints, weighted by length; unweighted where all lengths vanish. It need not lie on
  either surface.
* normal: mean of the normals, weighted as the points, at unit length. A mean shorter than 2^-20, as of curves that run
  around an object, gives way to the direction between the models' centres.
* depth: an estimate of how far the second object would have to move along the normal to come free. The contact curve
  encloses an area, seen along the normal; its faces say how fast that area shrinks with such a motion; depth is their
  quotient, at most the overlap of the two root boxes along the normal, which it is too where the area does not shrink.
  Without an area (points, shared planes) it is the overlap along the normal of the faces that touch. Exact for a box
  pressed straight into a larger one; (2 r + d) / 2 d times the truth for balls of radius r at distance d; half of it
  for the tip of a cone. It is not the penetration depth (the smallest motion in any direction), and no bound on it:
  where a curve runs over the edge of an object the mean normal leans over, and depth can be several times too large;
  for separate regions of contact and for open surfaces it is merely a length.

A pair without contacts has depth 0 and NaN as point and normal. The results are the same, bit for bit, on CPU and
CUDA, and for a pair named the other way the contacts differ in nothing but order, exchanged ends and signs.
"""

import numpy as np
import warp as wp

from warp_abtree.intersect import Query, Result
from warp_abtree.kernels import contact

VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")


def contact_dtypes(dtype=np.float64):
    """Return the types of `Result.contacts` and `Result.pair_contacts`, real numbers of a type inside.

    Raises:
        ValueError: The type is neither float32 nor float64.
    """
    try:
        real = np.dtype(dtype)
    except TypeError:
        real = None
    if real not in (np.float32, np.float64):
        raise ValueError(f"contact_dtype {dtype!r} is neither float32 nor float64")
    indices = [(name, np.int32) for name in ("pair", "face_a", "face_b")]
    vectors = [(name, real, (3,)) for name in VECTORS]
    means = [("point", real, (3,)), ("normal", real, (3,)), ("depth", real)]
    return np.dtype([*indices, *vectors, ("coplanar", bool)]), np.dtype([("count", np.int64), *means])


def find_contacts(query: Query, result: Result, dtype=np.float64):
    """Return contacts and summaries of a whole result that a query's last launch gave. Waits for the device.

    Args:
        query: Query of output "faces" whose scene has not changed since.
        dtype: Type of real numbers returned; they are computed in float64, and those beyond float32 become infinite.

    Returns:
        Structured arrays (k,) and (p,), world frame and world units, as the module's docstring defines them.

    Raises:
        ValueError: The type is neither float32 nor float64.
    """
    face_type, pair_type = contact_dtypes(dtype)
    contacts, means = np.zeros(len(result.faces), face_type), np.zeros(len(result.pairs), pair_type)
    for column, name in enumerate(("pair", "face_a", "face_b")):
        contacts[name] = result.faces[:, column]
    means["count"] = result.count
    means["point"] = means["normal"] = np.nan
    if not len(contacts):
        return contacts, means
    device = query.device
    found, summed = contact.Contacts(), contact.PairContacts()
    for name in VECTORS:
        setattr(found, name, wp.empty(len(contacts), dtype=wp.vec3d, device=device))
    found.coplanar = wp.empty(len(contacts), dtype=wp.int32, device=device)
    summed.point = wp.full(len(means), wp.vec3d(np.nan, np.nan, np.nan), dtype=wp.vec3d, device=device)
    summed.normal = wp.clone(summed.point)
    summed.depth = wp.zeros(len(means), dtype=wp.float64, device=device)
    start = np.concatenate([[0], np.cumsum(result.count)]).astype(np.int32)
    faces = wp.array(result.faces, dtype=wp.vec3i, device=device)
    inputs = [*(arrays.pool for arrays in query.arrays), query.pairs, query.pair_poses, faces]
    wp.launch(contact.find_contact_kernel, dim=len(contacts), inputs=[*inputs, found], device=device)
    start = wp.array(start, dtype=wp.int32, device=device)
    wp.launch(contact.reduce_contact_kernel, dim=len(means), inputs=[*inputs, start, found, summed], device=device)
    with np.errstate(over="ignore"):
        for name in (*VECTORS, "coplanar"):
            contacts[name] = getattr(found, name).numpy()
        for name in ("point", "normal", "depth"):
            means[name] = getattr(summed, name).numpy()
    return contacts, means
