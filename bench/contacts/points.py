"""Contact points of nuts at rest on bolts: penetration that they allow, and times of a launch.

A row for all faces and for each tolerance of the LODs. Penetration [um] is how deep the near faces of a pair get before
one of its points stops a motion, over twists of all poses: mean, 95th percentile and largest, and mean and 95th
percentile of the worst pose. The second object moves along a twist until a point blocks, at most twice the gap. To
first order, and without friction: a contact at p with normal n comes apart at the rate n . (v + w x (p - c)). All near
faces, as points, allow none, but stop what is free: two faces side by side of one another come apart along a direction
in which neither looks. So a second measure is of the meshes themselves. The object moves along a twist until a point
blocks, at most the gap, beyond which near faces know nothing (moved_um; all_moved_um where all near faces block).
really_um is how deep vertices of either mesh then lie inside the other one, beyond what they did at the start.

Times are of a launch over `--count` worlds at once, a nut and a bolt each; and of one world alone, on the CPU the time
of the thread on one core, in turn with the face pairs of that world.
"""

import time
from typing import NamedTuple

import numpy as np

import warp_abtree as ab

from ..cases.assembly import rest_nuts
from ..meshes import NUT, ModelFolder
from ..shapes import random_directions, scene_of_poses
from ..timing import medians, one_core, ratio_of, time_in_turn

FULL = {"poses": 8, "worlds": {"cuda": 1024, "cpu": 8}, "repeats": 5, "pushes": 100}
QUICK = {"poses": 2, "worlds": {"cuda": 2, "cpu": 2}, "repeats": 1, "pushes": 6}
LODS = {"all faces": None, "10 um": 1e-5, "30 um": 3e-5}  # tolerance [m]
GAP = 1e-4  # of the pair [m]
ASKED = (16, 32)
TWISTS, SEED = 2000, 20_260
CHUNK = 100  # twists at once
SLOWEST = 1e-9  # rate of approach under which a point does not block
SPARE = 1.1  # room for crossing faces over those of as many worlds like the judged ones


def run(device, quick=False, count=None, models=None):
    """Yield a row a LOD and number of points asked for.

    Columns: near is how many contacts a pose has within the gap, points how many of them were chosen; allowed_um and
    the like are penetration, moved_um to really_worst_pose_um that of the meshes themselves; worlds_ms is a launch over
    all worlds, one_ms over the first, faces_ms is `Query(scene, "faces")` of it and one_ratio one_ms over that.
    """
    sizes, folder = QUICK if quick else FULL, ModelFolder(models)
    missing = [name for name in NUT if not folder.has(name)]
    if missing:
        yield {"skipped": f"no {', '.join(missing)}: set ABTREE_MESHES to a folder that has them"}
        return
    parts = [folder.load([name]) for name in NUT]
    judged = rest_nuts(parts, sizes["poses"], 0)
    count = count or sizes["worlds"]["cuda" if device.is_cuda else "cpu"]
    placed = np.concatenate([judged, rest_nuts(parts, count, 1)])[:count]
    for name, tolerance in LODS.items():
        lods = [part.lod_max if tolerance is None else part.lod_for(tolerance=tolerance) for part in parts]
        faces = " on ".join(str(len(part.mesh_at(lod)[1])) for part, lod in zip(parts[::-1], lods[::-1]))
        scene, pairs = scene_of_poses(device, *parts, judged)
        scene.set_lods([lods[0]] + [lods[1]] * len(judged))
        near = scene.intersect(pairs, output="contacts", gap=GAP)
        for asked in ASKED:
            row = {"case": name, "faces": faces, "poses": len(judged)}
            found = ab.ManifoldQuery(scene, pairs, gap=GAP, points=asked).run()
            row |= judge(near, found) | {"asked": asked, "worlds": count}
            row |= push(parts, lods, judged, near, found, sizes["pushes"])
            yield row | time_worlds(device, parts, lods, placed, asked, found, sizes["repeats"])


class Contacts(NamedTuple):
    """Contacts of one pair, world frame; normals from the first object to the second."""

    point: np.ndarray  # (k, 3) [m]
    normal: np.ndarray  # (k, 3)
    separation: np.ndarray  # (k,) [m], negative inside


def random_twists(contacts: Contacts, count=TWISTS):
    """Return twists (count, 6), velocities and angular velocities about the mean of the contacts, and that mean.

    Their length is 1, a rotation counted by the speed of the contact that is farthest from the mean.
    """
    centre = contacts.point.mean(0)
    size = np.linalg.norm(contacts.point - centre, axis=1).max()
    twists = random_directions(np.random.default_rng(SEED), count, 6)
    twists[:, 3:] /= size
    return twists, centre


def wrenches(contacts: Contacts, centre):
    """Return what a twist is multiplied by for the rate at which each contact comes apart, (k, 6)."""
    return np.concatenate([contacts.normal, np.cross(contacts.point - centre, contacts.normal)], 1)


def blocked_at(twists, centre, points: Contacts, most):
    """Return how far each twist goes until a point blocks, at most so far."""
    approach = -(twists @ wrenches(points, centre).T)
    room = np.where(approach > SLOWEST, np.maximum(points.separation, 0), np.inf)
    return (room / np.maximum(approach, SLOWEST)).min(1, initial=most)


def penetration_allowed(contacts: Contacts, points: Contacts, gap, count=TWISTS):
    """Return how much deeper than at the start the near faces get along each twist [m], (count,)."""
    twists, centre = random_twists(contacts, count)
    moved = twists * blocked_at(twists, centre, points, 2 * gap)[:, None]
    across, at_start = wrenches(contacts, centre).T, max(0.0, -contacts.separation.min())
    parts = np.split(moved, range(CHUNK, count, CHUNK))
    least = np.concatenate([(part @ across + contacts.separation).min(1) for part in parts])
    return np.maximum(0.0, -least) - at_start


def points_of(found, p) -> Contacts:
    """Return the contact points of a pair."""
    own = found.points["pair"] == p
    return Contacts(found.points["point"][own], found.points["normal"][own], -found.points["depth"][own])


def contacts_of(near, p) -> Contacts:
    """Return all near faces of a pair as contacts, at the middle of their nearest points."""
    rows = near.contacts[near.contacts["pair"] == p]
    return Contacts((rows["p0"] + rows["p1"]) / 2, rows["normal"], rows["separation"])


def judge(near, found) -> dict:
    """Return the columns of penetration [um]; raise a RuntimeError where contacts and points are of other faces."""
    if not np.array_equal(near.any, found.any):
        raise RuntimeError("contacts and contact points differ about what intersects")
    allowed = []
    for p in range(len(near.pairs)):
        allowed.append(1e6 * penetration_allowed(contacts_of(near, p), points_of(found, p), GAP))
    allowed = np.array(allowed)
    means, tails = allowed.mean(1), np.percentile(allowed, 95, axis=1)
    row = {"near": near.count.mean(), "meet": near.any.sum(), "points": len(found.points["pair"]) / len(near.pairs)}
    row |= {"allowed_um": allowed.mean(), "allowed_p95_um": np.percentile(allowed, 95), "allowed_max_um": allowed.max()}
    return row | {"worst_pose_um": means.max(), "worst_pose_p95_um": tails.max()}


def moved_along(twist, centre):
    """Return the rigid motion of a twist, its velocity that of the centre, (4, 4)."""
    angle = np.linalg.norm(twist[3:])
    x, y, z = twist[3:] / (angle or 1.0)
    cross, motion = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(4)
    motion[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = centre + twist[:3] - motion[:3, :3] @ centre
    return motion


def normals_by_feature(vertices, faces):
    """Return what tells on which side of a mesh a point is, by its nearest feature: of each face its normal, the sums
    of its edges' two, opposite its corners, and those of its corners by angle, (f, 7, 3).

    Source: Baerentzen and Aanaes 2005, Signed distance computation using the angle weighted pseudonormal.
    """
    corners, others = vertices[faces], [(1, 2), (2, 0), (0, 1)]
    sides = [corners[:, j] - corners[:, i] for i, j in others]
    unit = [side / np.maximum(np.linalg.norm(side, axis=1), 1e-300)[:, None] for side in sides]
    normal = np.cross(sides[2], -sides[1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    found = np.zeros((len(faces), 7, 3))
    found[:, 0] = normal
    edges = np.sort(faces[:, others], axis=2).reshape(-1, 2)
    edge = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1, 3)
    sums, at_corner = np.zeros((edge.max() + 1, 3)), np.zeros((len(vertices), 3))
    for k in range(3):
        i, j = others[k]
        angle = np.arccos(np.clip(-(unit[i] * unit[j]).sum(1), -1, 1))
        np.add.at(sums, edge[:, k], normal)
        np.add.at(at_corner, faces[:, k], angle[:, None] * normal)
    found[:, 1:4], found[:, 4:] = sums[edge], at_corner[faces]
    return found


class Side(NamedTuple):
    """A mesh at a LOD, which points lie inside, and the vertices of the other one that are near it."""

    model: ab.Model
    lod: int
    corners: np.ndarray  # of its faces, by face of the file, (f, 3, 3)
    normals: np.ndarray  # `normals_by_feature`, (f, 7, 3)
    vertices: np.ndarray  # (k, 3), at the start in its own frame

    def distances(self, points):
        """Return signed distances of points, (n,), infinite beyond three gaps."""
        found = ab.signed_distance(self.model, points, self.lod, signed=False, nearest=True, within=3 * GAP)
        distance, nearest, face = found
        a, b, c = np.moveaxis(self.corners[face] - nearest[:, None], 1, 0)
        areas = np.stack([np.linalg.norm(np.cross(*pair), axis=1) for pair in ((b, c), (c, a), (a, b))], 1)
        off = areas <= 1e-6 * areas.sum(1)[:, None]  # corners that the nearest point is opposite of
        feature = np.where(
            off.sum(1) == 2, 4 + np.argmin(off, axis=1), np.where(off.any(1), 1 + np.argmax(off, axis=1), 0)
        )
        behind = np.einsum("ij,ij->i", points - nearest, self.normals[face, feature]) < 0
        return np.where(behind, -distance, distance)

    def depths(self, motions):
        """Return how deep the deepest vertex is after each motion of them [m], of those that were outside at the start,
        or inside by a tenth of the gap at most.

        Meshes that are not closed have no side everywhere: none can be deeper than it has moved beyond its distance at
        the start.
        """
        start = self.distances(self.vertices)
        outside = start > -GAP / 10
        vertices, start, found = self.vertices[outside], start[outside], []
        for motion in motions:
            points = vertices @ motion[:3, :3].T + motion[:3, 3]
            depth, way = -self.distances(points), np.linalg.norm(points - vertices, axis=1)
            found.append(np.where(depth > way - start + 1e-6 * GAP, 0.0, depth).max(initial=0.0))
        return np.array(found) - max(0.0, -start.min(initial=0.0))


def sides(parts, lods, pose):
    """Return the sides of the first mesh, and of the second one, which has a pose in the first's frame."""
    meshes = [part.mesh_at(lod) for part, lod in zip(parts, lods)]
    for k, matrix in enumerate((pose, np.linalg.inv(pose))):
        vertices, faces, face_ids = meshes[k]
        corners, normals = np.zeros((face_ids.max() + 1, 3, 3)), np.zeros((face_ids.max() + 1, 7, 3))
        corners[face_ids], normals[face_ids] = vertices[faces], normals_by_feature(vertices, faces)
        own = meshes[1 - k][0] @ matrix[:3, :3].T + matrix[:3, 3]
        near = np.isfinite(ab.signed_distance(parts[k], own, lods[k], signed=False, within=3 * GAP))
        yield Side(parts[k], lods[k], corners, normals, own[near])


def push(parts, lods, poses, near, found, count) -> dict:
    """Return columns of motions that points block, so many twists a pose, and of how deep the meshes are then [um]."""
    ways, all_ways, depths = [], [], []
    for p, pose in enumerate(poses):
        contacts = contacts_of(near, p)
        twists, centre = random_twists(contacts, count)
        ways.append(blocked_at(twists, centre, points_of(found, p), GAP))
        all_ways.append(blocked_at(twists, centre, contacts, GAP))
        motions = [moved_along(way * twist, centre) for way, twist in zip(ways[-1], twists)]
        first, second = sides(parts, lods, pose)
        back = [np.linalg.inv(pose) @ np.linalg.inv(motion) @ pose for motion in motions]
        scene, pairs = scene_of_poses("cpu", *parts, np.array(motions) @ pose)
        scene.set_lods([lods[0]] + [lods[1]] * len(motions))
        cross = scene.intersect(pairs, "any").any != 0  # else nothing is inside
        depths.append(np.where(cross, np.maximum(first.depths(motions), second.depths(back)), 0.0))
    row = {"moved_um": np.mean(ways), "all_moved_um": np.mean(all_ways), "really_um": np.mean(depths)}
    row |= {"really_p95_um": np.percentile(depths, 95), "really_worst_pose_um": np.mean(depths, axis=1).max()}
    return {key: 1e6 * value for key, value in row.items()}


def time_worlds(device, models, lods, matrices, asked, found, repeats) -> dict:
    """Return the columns of times of a bolt and a nut in each world; raise a RuntimeError where worlds have other
    points than the poses judged."""
    scene, worlds = ab.Scene(device=device), len(matrices)
    pairs, poses = np.arange(2 * worlds).reshape(-1, 2), np.tile(np.eye(4), (2 * worlds, 1, 1))
    poses[1::2] = matrices
    scene.add_many(models * worlds, poses, worlds=np.arange(2 * worlds) // 2)
    scene.set_lods(lods * worlds)
    capacity = ab.Buffers(hits=1024 + int(SPARE * found.count.mean() * len(pairs)))
    query = ab.ManifoldQuery(scene, pairs, capacity, gap=GAP, points=asked)
    result = query.run()
    for p in range(min(len(pairs), len(found.pairs))):
        if any(a.tobytes() != b.tobytes() for a, b in zip(points_of(result, p), points_of(found, p))):
            raise RuntimeError(f"the points of pose {p} differ between scenes")
    taken = medians(time_in_turn({"worlds": query.launch}, device, repeats))
    query.result().check()
    one = ab.ManifoldQuery(scene, pairs[:1], capacity, gap=GAP, points=asked)
    faces = ab.Query(scene, "faces", pairs=pairs[:1])
    one.run(), faces.run()
    with one_core():
        times = time_in_turn({"one": one.launch, "faces": faces.launch}, device, repeats, time.thread_time)
    taken |= medians(times)
    return {f"{name}_ms": ms for name, ms in taken.items()} | {"one_ratio": ratio_of(times["one"], times["faces"])}
