"""Distances, nearest points and depths: python scenes/02_how_far.py (docs/howto_distance.md)."""

import trimesh

import warp_abtree as ab

ring = ab.Model.load(trimesh.creation.torus(1.0, 0.3))
ball = ab.Model.load(trimesh.creation.icosphere(subdivisions=3, radius=0.4))
scene = ab.Scene(device="cpu")
scene.add(ring, solid=True)  # a solid holds what lies inside it; without it, its surface alone counts
for position in ((0.1, 0, 0), (2.2, 0, 0.4), (0, -1.2, 0.55)):  # in the hole, beside, and in the ring
    scene.add(ball, pose=(*position, 0, 0, 0, 1), solid=True)

pairs = [(0, 1), (0, 2), (0, 3)]
result = scene.intersect(pairs, "distance", signed=True)
print(result.distance)  # the third is negative: the depth of the deepest point
print(result.bracket[0])  # proven lower and upper bound
print(result.points[0])  # the nearest point of either object, world frame
print(result.point_faces[0])  # the faces on which they lie

near = scene.intersect(pairs, "distance", beyond=0.25)  # farther apart than that is far enough
print(near.distance)  # inf: proved farther apart
rough = scene.intersect(pairs, "distance", relative=0.1)  # within 10 % of the distance, for half of the time
print(rough.bracket)
