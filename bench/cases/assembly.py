"""Nested parts: a nut on its bolt, a peg in its hole, meshed gears, free and crossing, on one core or a GPU.

The meshes are those of IsaacGymEnvs (`bench.meshes`: ABTREE_MESHES, or ../shared/meshes). A nut turns along the thread
from a height at which it is free; crossing poses are moved sideways, gears turned. Baselines are python-fcl and the
wp.Bvh over faces whose constructor answers fastest. Times are of a pose: of all poses at once from the launch to the
result on the host, and of one pair alone, which a query answers (one) or `Scene.intersect` (scene). A baseline takes
objects made before. Of `--count` worlds each: `--only newton`, contacts of nuts on bolts where Newton is installed;
`--only hammered`, nuts under blows.
"""

import importlib.util
import time

import numpy as np
import warp as wp

import warp_abtree as ab

from ..baselines import newton_nuts
from ..baselines.fcl import Fcl
from ..baselines.wp_bvh import BvhPosed, find_constructor
from ..meshes import ModelFolder
from ..motions import hammered
from ..shapes import scene_of_poses
from ..timing import medians, no_garbage_collection, one_core, time_in_turn

FULL, QUICK = (
    {"poses": 64, "worlds": 2048, "nuts": 1000, "repeats": 5},
    {"poses": 3, "worlds": 1, "nuts": 1, "repeats": 1},
)
IDENTITY = (0, 0, 0, 0, 0, 0, 1)
OUTPUTS = ("faces", "any")
TURNS, PITCH = 5, 2.5e-3  # of a nut that starts at the first height, and of an M20 thread [m]
NUT_HEIGHT, PEG_HEIGHT = 0.01, -0.01  # where heights are scanned from; where the peg stands [m]
GEAR_TURN = 0.03  # that teeth have room for, at most, either way


def run(device, quick=False, only=None, count=None, models=None):
    """Yield a row a workload: times a pose [ms] of ours, and those of baselines over ours."""
    device = wp.get_device(device)
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
            yield {"case": name} | measure_newton(loaded, count or sizes["worlds"], device, sizes["repeats"])
            continue
        for kind, matrices in place(loaded, sizes["poses"]).items():
            with one_core():
                yield measure(f"{name}, {kind}", loaded, matrices, device, sizes["repeats"])
    if not only or "hammered" in only:
        steps = 4 if quick else hammered.STEPS
        yield {"case": "hammered"} | hammered.measure(count or sizes["nuts"], device, steps)


def measure_newton(models, worlds, device, repeats):
    """Return the row of nuts in worlds of Newton's, or why there is none."""
    if importlib.util.find_spec("newton") is None:
        return {"skipped": "no package newton"}
    poses = (rest_nuts(models, worlds, seed) for seed in (0, 1))
    return newton_nuts.measure(models, *poses, device, 3 * repeats)


def rest_nuts(models, count, seed):
    """Return poses of nuts anywhere along the thread, which they rest on: it is as far as 5 um, or within 1 um."""
    rng = np.random.default_rng(seed)
    heights = NUT_HEIGHT + np.linspace(0, PITCH, 51)
    free = heights[count_hits(models, np.stack([turned(0, z=z) for z in heights])) == 0]
    height, step = free.min(), PITCH / 50
    while step > 1e-7:  # the lowest that is free
        step /= 2
        height -= step * (count_hits(models, turned(0, z=height - step)[None])[0] == 0)
    angles = rng.uniform(0, 2 * np.pi * TURNS, count)
    rise = height + PITCH * angles / (2 * np.pi) + rng.uniform(-1e-6, 5e-6, count)
    return np.stack([turned(angle, z=z) for angle, z in zip(angles, rise)])


def turned(angle, x=0.0, y=0.0, z=0.0, centre=(0.0, 0.0, 0.0)):
    """Return a matrix that turns about z, around a centre, and then moves."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre + (x, y, z)
    return matrix


def count_hits(models, matrices):
    """Return the intersecting face pairs at each pose, exactly."""
    scene, pairs = scene_of_poses("cpu", *models, [IDENTITY] * len(matrices))
    scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))
    return scene.intersect(pairs, "faces").count


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
    heights = NUT_HEIGHT + np.linspace(0, PITCH, 51)
    free = np.flatnonzero(count_hits(models, np.stack([turned(0, z=z) for z in heights])) == 0)
    run_length = int(np.argmin(np.append(np.diff(free) == 1, False))) + 1
    height = heights[free[:run_length]].mean()
    angles = np.linspace(0, 2 * np.pi * TURNS, count, endpoint=False)
    matrices = np.stack([turned(angle, z=height + PITCH * angle / (2 * np.pi)) for angle in angles])
    return {"free": matrices, "crossing": shift_until_crossing(models, matrices)}


def place_peg(models, count):
    matrices = np.stack([turned(angle, z=PEG_HEIGHT) for angle in np.linspace(0, 2 * np.pi, count, endpoint=False)])
    return {"free": matrices, "crossing": shift_until_crossing(models, matrices)}


def place_gears(models, count):
    """Return poses of the second gear, turned about its own axis a little, and by a quarter of a tooth as well."""
    vertices = models[1].mesh_at(models[1].lod_max)[0]
    centre = (vertices.min(0) + vertices.max(0)) / 2
    angles = np.linspace(-GEAR_TURN, GEAR_TURN, count) / 2
    near, far = (np.stack([turned(a + more, centre=centre) for a in angles]) for more in (0.0, 2.5 * GEAR_TURN))
    return {"free": near, "crossing": far}


CASES = (
    ("nut on bolt", ("factory-bolt-m20", "factory-nut-m20"), place_nut),
    ("peg in hole", ("factory-hole-8mm", "factory-peg-8mm"), place_peg),
    ("gears", ("factory-gear-medium", "factory-gear-small"), place_gears),
    ("newton", ("factory-bolt-m20", "factory-nut-m20"), None),
)


def measure(name, models, matrices, device, repeats):
    """Return the row of one workload.

    Raises:
        RuntimeError: Outputs differ about what intersects.
    """
    meshes = [model.mesh_at(model.lod_max)[:2] for model in models]
    scene, pairs = scene_of_poses(device, *models, [IDENTITY] * len(matrices))
    scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))
    queries = {output: ab.Query(scene, output, pairs=pairs) for output in OUTPUTS}
    found = {output: query.run() for output, query in queries.items()}
    if not np.array_equal(found["any"].any, found["faces"].count > 0):
        raise RuntimeError("outputs 'any' and 'faces' of ours differ")
    row = {"device": device.name, "workload": name, "faces": " x ".join(str(len(mesh[1])) for mesh in meshes)}
    row |= {"poses": len(pairs), "meet": int(found["any"].any.sum()), "hits": int(found["faces"].count.sum())}
    others = {"wp_bvh": make_bvh(meshes, matrices, device, row["hits"])}
    row["wp_bvh_differs"] = int((others["wp_bvh"]["any"]() != found["any"].any).sum())
    try:
        others["fcl"] = fcl = Fcl(*meshes, matrices)
        row["fcl_differs"] = int((np.array(fcl.any(), bool) != found["any"].any).sum())
    except ImportError as error:
        row["fcl_skipped"] = str(error)
    middle = len(pairs) // 2
    ones = {output: ab.Query(scene, output, pairs=pairs[middle : middle + 1]) for output in OUTPUTS}
    for output in OUTPUTS:
        launches = {"ours": run_to_host(queries[output]), "one": run_to_host(ones[output])}
        launches["scene"] = lambda output=output: scene.intersect(pairs[middle : middle + 1], output)
        for key, other in others.items():
            launches[key] = other[output] if key == "wp_bvh" else getattr(other, output)
        if "fcl" in others:
            launches["fcl_one"] = lambda output=output: others["fcl"].ask_one(middle, output)
        clock = time.thread_time if device.is_cpu else time.perf_counter
        with no_garbage_collection():
            times = medians(time_in_turn(launches, wp.get_device("cpu"), repeats, clock))
        row |= {f"{output}_ms": round(times["ours"] / len(pairs), 4)}
        row |= {f"{output}_{key}_ms": round(times[key], 4) for key in ("one", "scene")}
        for key, base in {"wp_bvh": "ours", "fcl": "ours", "fcl_one": "one"}.items():
            if key in times:
                row[f"{output}_{key}_ratio"] = round(times[key] / times[base], 2)
    return row


def run_to_host(query):
    """Return a callable that launches a query and returns its result."""
    return lambda: (query.launch(), query.result())[1]


def make_bvh(meshes, matrices, device, hits):
    """Return callables that ask the wp.Bvh baseline, by output; room for false hits, of which it has many."""
    poses = np.zeros((2 * len(matrices), 7), np.float32)
    poses[:, 6] = 1
    poses[1::2] = [wp.transform(*wp.transform_decompose(wp.mat44(matrix))[:2]) for matrix in matrices]
    arguments = dict(device=device, other=meshes[0])
    constructor = find_constructor(*meshes[1], poses, **arguments)
    room = {"faces": 10 * hits + 10**7, "any": None}
    made = {
        output: BvhPosed(*meshes[1], poses, room[output], constructor=constructor, **arguments) for output in OUTPUTS
    }
    return {output: run_to_host(baseline) for output, baseline in made.items()}
