"""Contact points of nuts at rest on bolts: penetration that they allow, and times of a launch.

A row for all faces and for each tolerance of the LODs. Penetration [um] is that of `bench.contacts.penetration`, over
twists of all poses: mean, 95th percentile and largest, and mean and 95th percentile of the worst pose. Times are of a
launch over `--count` worlds at once, a nut and a bolt each; and of one world alone, on the CPU the time of the thread
on one core, in turn with the face pairs of that world.
"""

import time

import numpy as np

import warp_abtree as ab

from ..cases.assembly import rest_nuts
from ..meshes import NUT, ModelFolder
from ..shapes import scene_of_poses
from ..timing import medians, one_core, ratio_of, time_in_turn
from .penetration import Contacts, near_contacts, penetration_allowed

FULL = {"poses": 8, "worlds": {"cuda": 1024, "cpu": 8}, "repeats": 5}
QUICK = {"poses": 2, "worlds": {"cuda": 2, "cpu": 2}, "repeats": 1}
LODS = {"all faces": None, "10 um": 1e-5, "30 um": 3e-5}  # tolerance [m]
GAP = 1e-4  # of the pair [m]
ASKED = (16, 32)
SPARE = 1.1  # room for crossing faces over those of as many worlds like the judged ones


def run(device, quick=False, count=None, models=None):
    """Yield a row a LOD and number of points asked for.

    Columns: near is how many contacts a pose has within the gap, points how many of them were chosen; allowed_um and
    the like are penetration; worlds_ms is a launch over all worlds, one_ms over the first, faces_ms is
    `Query(scene, "faces")` of it and one_ratio one_ms over that.
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
            yield row | time_worlds(device, parts, lods, placed, asked, found, sizes["repeats"])


def points_of(found, p) -> Contacts:
    """Return the contact points of a pair."""
    own = found.points["pair"] == p
    return Contacts(found.points["point"][own], found.points["normal"][own], -found.points["depth"][own])


def judge(near, found) -> dict:
    """Return the columns of penetration [um]; raise a RuntimeError where contacts and points are of other faces."""
    if not np.array_equal(near.any, found.any):
        raise RuntimeError("contacts and contact points differ about what intersects")
    allowed = []
    for p in range(len(near.pairs)):
        contacts = near_contacts(near.contacts[near.contacts["pair"] == p])
        allowed.append(1e6 * penetration_allowed(contacts, points_of(found, p), GAP))
    allowed = np.array(allowed)
    means, tails = allowed.mean(1), np.percentile(allowed, 95, axis=1)
    row = {"near": near.count.mean(), "meet": near.any.sum(), "points": len(found.points["pair"]) / len(near.pairs)}
    row |= {"allowed_um": allowed.mean(), "allowed_p95_um": np.percentile(allowed, 95), "allowed_max_um": allowed.max()}
    return row | {"worst_pose_um": means.max(), "worst_pose_p95_um": tails.max()}


def scene_of_worlds(device, models, lods, matrices):
    """Return a scene that has a bolt and a nut in each world, and its pairs (2 w, 2 w + 1)."""
    scene, worlds = ab.Scene(device=device), len(matrices)
    poses = np.tile(np.eye(4), (2 * worlds, 1, 1))
    poses[1::2] = matrices
    scene.add_many(models * worlds, poses, worlds=np.arange(2 * worlds) // 2)
    scene.set_lods(lods * worlds)
    return scene, np.arange(2 * worlds).reshape(-1, 2)


def time_worlds(device, models, lods, matrices, asked, found, repeats) -> dict:
    """Return the columns of times; raise a RuntimeError where worlds have other points than the poses judged."""
    scene, pairs = scene_of_worlds(device, models, lods, matrices)
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
