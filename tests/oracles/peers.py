"""Face pairs from FCL, which has tolerances of its own, and a referee for where its answer and ours differ."""

import numpy as np

from oracles.triangle import into_frame_of_a, pairs_intersect, pose_matrix

STILL = (0, 0, 0, 0, 0, 0, 1)


def fcl_object(vertices, faces, pose=STILL):
    """Return a mesh as FCL has it, at a pose."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32))
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform(*pose_matrix(pose)))


def fcl_faces(vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Set of intersecting (face of A, face of B) after FCL."""
    import fcl

    objects = fcl_object(vertices_a, faces_a, pose_a), fcl_object(vertices_b, faces_b, pose_b)
    request = fcl.CollisionRequest(num_max_contacts=2**31 - 1, enable_contact=True)
    result = fcl.CollisionResult()
    fcl.collide(*objects, request, result)
    return {(contact.b1, contact.b2) for contact in result.contacts}


def judge(ours, theirs, vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Return the pairs that only one side reports and that side is wrong about: (ours, theirs), by the exact test."""
    ours, theirs = ({(int(p), int(q)) for p, q in answer} for answer in (ours, theirs))
    disputed = sorted(ours ^ theirs)
    points_b = into_frame_of_a(vertices_b, pose_a, pose_b)
    truth = pairs_intersect(np.asarray(vertices_a, np.float64), faces_a, points_b, faces_b, disputed)
    judged = list(zip(disputed, truth, strict=True))
    return tuple([pair for pair, meets in judged if (pair in side) != meets] for side in (ours, theirs))
