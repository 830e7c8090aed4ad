"""A question of your own, the area near an object: python scenes/06_your_own_query.py (docs/howto_own_query.md)."""

import trimesh
import warp as wp

import warp_abtree as ab
from warp_abtree.query.stages.faces import FaceQuery, PairPose, Trees, face_distance


@wp.struct
class NearFaces:
    distance: wp.float64
    near: wp.array2d(dtype=wp.uint8)  # 1 for faces of a pair's first object that are near its second one


@wp.func
def visit(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: NearFaces):
    is_near = face_distance(trees, pose, faces) <= own.distance
    if is_near:
        own.near[pair, faces[pose.swapped]] = wp.uint8(1)  # whatever the order of visits, the same
    return is_near


def near_faces(scene, face_count, pairs, distance):
    """Return which faces of each pair's first object are near its second one, (pair, face)."""
    own = NearFaces()
    own.distance = wp.float64(distance)
    own.near = wp.zeros((len(pairs), face_count), dtype=wp.uint8, device=scene.device)
    FaceQuery(scene, visit, own, pairs, within=distance).run()
    return own.near.numpy() == 1


plate = trimesh.creation.box((3.0, 1.0, 0.1)).subdivide_to_size(0.12)
ball = ab.Model.load(trimesh.creation.icosphere(subdivisions=3, radius=0.45))
scene = ab.Scene(device="cpu")  # or "cuda:0": the same areas
scene.add(ab.Model.load(plate))
for x in (-1, 0, 1):  # the first ball reaches into the plate
    scene.add(ball, pose=(x, 0, 0.53 + 0.06 * x, 0, 0, 0, 1))
near = near_faces(scene, len(plate.faces), [(0, 1), (0, 2), (0, 3)], 0.1)
print("area of the plate within 0.1 of each ball:", (near @ plate.area_faces).round(3))
