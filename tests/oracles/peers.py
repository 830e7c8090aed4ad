"""Face pairs from an independent library (FCL), and a referee for where its answer and ours differ.

FCL tests triangles in float64 with tolerances of its own and transforms them itself, so it differs in borderline cases;
the exact oracle says who is wrong in each of them.
"""

import numpy as np

from oracles.triangle import into_frame_of_a, pairs_intersect, pose_matrix


def _fcl_object(fcl, vertices, faces, pose):
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32))
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform(*pose_matrix(pose)))


def fcl_faces(vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Set of intersecting (face of A, face of B) after FCL."""
    import fcl

    a = _fcl_object(fcl, vertices_a, faces_a, pose_a)
    b = _fcl_object(fcl, vertices_b, faces_b, pose_b)
    request = fcl.CollisionRequest(num_max_contacts=2**31 - 1, enable_contact=True)
    result = fcl.CollisionResult()
    fcl.collide(a, b, request, result)
    return {(contact.b1, contact.b2) for contact in result.contacts}


def judge(ours, theirs, vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Return the pairs that only one side reports and that side is wrong about: (ours, theirs), by the exact test."""
    ours, theirs = ({(int(p), int(q)) for p, q in answer} for answer in (ours, theirs))
    disputed = sorted(ours ^ theirs)
    points_b = into_frame_of_a(vertices_b, pose_a, pose_b)
    truth = pairs_intersect(np.asarray(vertices_a, np.float64), faces_a, points_b, faces_b, disputed)
    wrong = [], []
    for pair, meets in zip(disputed, truth, strict=True):
        wrong[0 if (pair in ours) != meets else 1].append(pair)
    return wrong
