"""Face pairs from an independent library (FCL), and a referee for where its answer and ours differ.

FCL tests triangles in float64 with tolerances of its own and transforms them itself, so it differs in borderline cases;
the exact oracle says who is wrong in each of them.
"""

from dataclasses import dataclass

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


def fcl_distance(vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Distance of two meshes that do not intersect, after FCL."""
    import fcl

    a = _fcl_object(fcl, vertices_a, faces_a, pose_a)
    b = _fcl_object(fcl, vertices_b, faces_b, pose_b)
    return fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult())


@dataclass
class Verdict:
    """Sorted lists of (face of A, face of B), each pair that only one side reported, by who is wrong."""

    ours_missed: list
    ours_invented: list
    peer_missed: list
    peer_invented: list

    @property
    def ours_wrong(self):
        return self.ours_missed + self.ours_invented

    @property
    def peer_wrong(self):
        return self.peer_missed + self.peer_invented


def judge(ours, peer, vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """Classify the symmetric difference of two answers by the exact test. Pairs that both report are not judged."""
    ours, peer = ({(int(p), int(q)) for p, q in answer} for answer in (ours, peer))
    disputed = sorted(ours ^ peer)
    points_b = into_frame_of_a(vertices_b, pose_a, pose_b)
    truth = pairs_intersect(np.asarray(vertices_a, np.float64), faces_a, points_b, faces_b, disputed)
    verdict = Verdict([], [], [], [])
    for pair, meets in zip(disputed, truth, strict=True):
        if pair in ours:
            (verdict.peer_missed if meets else verdict.ours_invented).append(pair)
        else:
            (verdict.ours_missed if meets else verdict.peer_invented).append(pair)
    return verdict
