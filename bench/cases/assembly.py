"""Nested parts: a nut on its bolt, a peg in its hole, meshed gears, free and crossing, on one core or a GPU.

The meshes are those of IsaacGymEnvs (`bench.meshes`: ABTREE_MESHES, or ../shared/meshes). A nut turns along the thread
from a height at which it is free; crossing poses are moved sideways, gears turned. The baseline is python-fcl. Times
are of a pose: of all poses at once from the launch to the result on the host, and of one pair alone (one). A baseline
takes objects made before. Of `--count` worlds each: `--only newton`, contacts of nuts on bolts where Newton is
installed; `--only hammered`, nuts under blows.
"""

import importlib.util
from functools import partial

import numpy as np

import warp_abtree as ab

from ..baselines import newton_nuts
from ..baselines.fcl import Fcl
from ..meshes import NUT, ModelFolder
from ..motions import hammered
from ..shapes import centre_and_radius, scene_of_poses
from ..timing import medians, one_core, ratio_of, time_on_host, to_host

FULL = {"poses": 64, "worlds": 2048, "nuts": 1000, "repeats": 5}
QUICK = {"poses": 3, "worlds": 1, "nuts": 1, "repeats": 1}
OUTPUTS = ("faces", "any")
TURNS, PITCH = 5, 2.5e-3  # of a nut that starts at the first height, and of an M20 thread [m]
NUT_HEIGHT, PEG_HEIGHT = 0.01, -0.01  # where heights are scanned from; where the peg stands [m]
GEAR_TURN = 0.03  # that teeth have room for, at most, either way


def run(device, quick=False, only=None, count=None, models=None):
    """Yield a row a workload: times a pose [ms] of ours, and those of python-fcl over ours."""
    sizes = QUICK if quick else FULL
    folder = ModelFolder(models)
    for name, files, place in CASES:
        if only and name.split()[0] not in only:
            continue
        missing = [file for file in files if not folder.has(file)]
        if missing:
            yield {"case": name, "skipped": f"no {', '.join(missing)}: set ABTREE_MESHES to a folder that has them"}
            continue
        loaded = [folder.load([file]) for file in files]
        if place is None:
            row = {"skipped": "no package newton"}
            if importlib.util.find_spec("newton"):
                poses = (rest_nuts(loaded, count or sizes["worlds"], seed) for seed in (0, 1))
                row = newton_nuts.measure(loaded, *poses, device, 3 * sizes["repeats"])
            yield {"case": name} | row
            continue
        for kind, matrices in place(loaded, sizes["poses"]).items():
            with one_core():
                yield measure(f"{name}, {kind}", loaded, matrices, device, sizes["repeats"])
    if not only or "hammered" in only:
        steps = 4 if quick else hammered.STEPS
        yield {"case": "hammered"} | hammered.measure(count or sizes["nuts"], device, steps)


def rest_nuts(models, count, seed):
    """Return poses of nuts anywhere along the thread, which they rest on: it is as far as 5 um, or within 1 um."""
    rng = np.random.default_rng(seed)
    heights = free_heights(models)
    height, step = heights.min(), PITCH / 50
    while step > 1e-7:  # the lowest that is free
        step /= 2
        height -= step * (count_hits(models, turned(0, z=height - step)[None])[0] == 0)
    angles = rng.uniform(0, 2 * np.pi * TURNS, count)
    return follow_thread(angles, height + rng.uniform(-1e-6, 5e-6, count))


def turned(angle, z=0.0, centre=(0.0, 0.0, 0.0)):
    """Return a matrix that turns about z, around a centre, and then moves along it."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre + (0.0, 0.0, z)
    return matrix


def follow_thread(angles, heights):
    """Return poses of nuts that have turned from heights where they were free."""
    return np.stack([turned(a, z=z) for a, z in zip(angles, heights + PITCH * angles / (2 * np.pi))])


def count_hits(models, matrices):
    """Return the intersecting face pairs at each pose, exactly."""
    scene, pairs = scene_of_poses("cpu", *models, matrices)
    return scene.intersect(pairs, "faces").count


def free_heights(models):
    """Return the heights of a pitch, a fiftieth apart, at which a nut is free."""
    heights = NUT_HEIGHT + np.linspace(0, PITCH, 51)
    return heights[count_hits(models, np.stack([turned(0, z=z) for z in heights])) == 0]


def shift_until_crossing(models, matrices):
    """Return poses moved sideways, each to another side, by the first power of two [um] at which all cross."""
    shift, angles = 1e-6, np.arange(len(matrices)) * 2.4
    while True:
        moved = matrices.copy()
        moved[:, :2, 3] += shift * np.stack([np.cos(angles), np.sin(angles)], 1)
        if (count_hits(models, moved) > 0).all():
            return moved
        shift *= 2


def place_nut(models, count):
    """Return a nut's poses along the thread, in the middle of the first heights at which it is free, and crossing."""
    heights = free_heights(models)
    first = np.cumsum(np.diff(heights, prepend=heights[0]) > 0.03 * PITCH) == 0  # up to the first gap
    angles = np.linspace(0, 2 * np.pi * TURNS, count, endpoint=False)
    matrices = follow_thread(angles, heights[first].mean())
    return {"free": matrices, "crossing": shift_until_crossing(models, matrices)}


def place_peg(models, count):
    matrices = np.stack([turned(angle, z=PEG_HEIGHT) for angle in np.linspace(0, 2 * np.pi, count, endpoint=False)])
    return {"free": matrices, "crossing": shift_until_crossing(models, matrices)}


def place_gears(models, count):
    """Return poses of the second gear, turned about its own axis a little, and by a quarter of a tooth as well."""
    centre, _ = centre_and_radius(models[1])
    angles = np.linspace(-GEAR_TURN, GEAR_TURN, count) / 2
    near, far = (np.stack([turned(a + more, centre=centre) for a in angles]) for more in (0.0, 2.5 * GEAR_TURN))
    return {"free": near, "crossing": far}


CASES = (
    ("nut on bolt", NUT, place_nut),
    ("peg in hole", ("factory-hole-8mm", "factory-peg-8mm"), place_peg),
    ("gears", ("factory-gear-medium", "factory-gear-small"), place_gears),
    ("newton", NUT, None),
)


def measure(name, models, matrices, device, repeats):
    """Return the row of one workload; raise a RuntimeError where outputs differ about what intersects."""
    meshes = [model.mesh_at(model.lod_max)[:2] for model in models]
    scene, pairs = scene_of_poses(device, *models, matrices)
    queries = {output: ab.Query(scene, output, pairs=pairs) for output in OUTPUTS}
    found = {output: query.run() for output, query in queries.items()}
    if not np.array_equal(found["any"].any, found["faces"].count > 0):
        raise RuntimeError("outputs 'any' and 'faces' of ours differ")
    row = {"workload": name, "faces": " x ".join(str(len(mesh[1])) for mesh in meshes)}
    row |= {"poses": len(pairs), "meet": found["any"].any.sum(), "hits": found["faces"].count.sum()}
    fcl = None
    try:
        fcl = Fcl(*meshes, matrices)
        row["fcl_differs"] = (np.array(fcl.any(), bool) != found["any"].any).sum()
    except ImportError as error:
        row["fcl_skipped"] = str(error)
    middle = slice(len(pairs) // 2, len(pairs) // 2 + 1)
    for output in OUTPUTS:
        one = ab.Query(scene, output, pairs=pairs[middle])
        launches = {"ours": to_host(queries[output]), "one": to_host(one)}
        if fcl:
            launches |= {"fcl": getattr(fcl, output), "fcl_one": partial(getattr(fcl, output), middle)}
        times = time_on_host(launches, device, repeats)
        taken = medians(times)
        row |= {f"{output}_ms": taken["ours"] / len(pairs), f"{output}_one_ms": taken["one"]}
        for key, base in {"fcl": "ours", "fcl_one": "one"}.items() if fcl else ():
            row[f"{output}_{key}_ratio"] = ratio_of(times[key], times[base])
    return row
