"""Time and memory against the number of object pairs, of faces and of worlds, and the slopes of the log-log lines."""

import gc
import time

import numpy as np

import warp_abtree as ab

from ..baselines.wp_bvh import BvhPosed
from ..memory import memory_columns
from ..meshes import ModelFolder
from ..shapes import longest_side, pair_poses, random_poses, scene_of_objects
from ..timing import fit_slope, ratio_of, summarise, time_in_turn, upper_half

CUDA = {
    "pairs": {"faces": 5000, "counts": (1, 10, 100, 1000, 10_000, 100_000)},
    "faces": {"sizes": (200, 1000, 5000, 20_000, 100_000, 250_000, 1_000_000), "pairs": (1, 64)},
    "worlds": {"faces": 1000, "counts": (1, 4, 16, 64, 256, 1024, 4096, 16_384)},
    "repeats": 11,
}
CPU = {
    "pairs": {"faces": 500, "counts": (1, 10, 100, 1000, 10_000)},
    "faces": {"sizes": (200, 1000, 5000, 20_000, 60_000), "pairs": (1, 64)},
    "worlds": {"faces": 500, "counts": (1, 4, 16, 64, 256, 1024)},
    "repeats": 5,
}
QUICK = {
    "pairs": {"faces": 200, "counts": (1, 4, 16)},
    "faces": {"sizes": (200, 600), "pairs": (1, 3)},
    "worlds": {"faces": 200, "counts": (1, 8)},
    "repeats": 2,
}
DISTANCE = 0.9
OBJECTS = 4  # a world
CHECKED = 3  # pairs and worlds asked again by themselves, where other numbers of warps work on each


def run(device, quick=False, models=None):
    """Yield one row a size, and after each sweep one with the slopes of its lines, all sizes and the upper half.

    build_s is the time to make scene and query, first_s that of the first run, which compiles and grows buffers. Memory
    is that of scene and query, before there is a baseline. broad is the broad phase of worlds alone.
    """
    sizes = QUICK if quick else CUDA if device.is_cuda else CPU
    repeats, folder = sizes["repeats"], ModelFolder(models)
    model = folder.load([f"knot:{sizes['pairs']['faces']}"])
    yield from with_slopes("pairs", (run_pairs(device, model, n, repeats) for n in sizes["pairs"]["counts"]))
    meshes = [folder.load([f"knot:{faces}"]) for faces in sizes["faces"]["sizes"]]
    for count in sizes["faces"]["pairs"]:
        yield from with_slopes("faces", (run_pairs(device, mesh, count, repeats) for mesh in meshes))
    model = folder.load([f"knot:{sizes['worlds']['faces']}"])
    yield from with_slopes("worlds", (run_worlds(device, model, n, repeats) for n in sizes["worlds"]["counts"]))


def with_slopes(sweep, found):
    """Yield the rows of a sweep as they come, and one of the slopes of its lines."""
    rows = []
    for row in found:
        rows.append({"sweep": sweep} | row)
        yield rows[-1]
    row = {"sweep": f"{sweep}: slope", "sizes": len(rows), "pairs": rows[0]["pairs"]}
    for name in ("ours_ms", "peer_ms", "broad_ms", "arrays_mib", "pool_mib"):
        if name in rows[0]:
            for label, some in ((f"{name}_slope", rows), (f"{name}_slope_upper", upper_half(rows))):
                row[label] = fit_slope([r[sweep] for r in some], [r[name] for r in some])
    yield row


def make_query(device, model, poses, pairs=None, world_size=None):
    """Return a scene of a model at poses, a query of all face pairs, its first result, and columns of both."""
    gc.collect()  # scenes and their queries hold each other
    begin = time.perf_counter()
    scene = scene_of_objects(device, model, poses, world_size)
    query = ab.Query(scene, "faces", pairs=pairs)
    made = time.perf_counter()
    result = query.run()
    row = {"faces": model.face_count, "pairs": len(result.pairs), "hits": len(result.faces)}
    row |= {"build_s": made - begin, "first_s": time.perf_counter() - made}
    return scene, query, result, row | memory_columns(scene, query)


def run_pairs(device, model, pair_count, repeats):
    """Return the row of one batch of pairs of a model, beside wp.Bvh."""
    poses, pairs = pair_poses(pair_count, DISTANCE), np.arange(2 * pair_count).reshape(-1, 2)
    scene, query, result, row = make_query(device, model, poses, pairs)
    for pair in range(0, pair_count, max(1, pair_count // CHECKED)):
        check_alone(scene, result, pairs[pair : pair + 1])
    baseline = BvhPosed(*model.mesh_at(model.lod_max)[:2], poses, 2 * len(result.faces) + 1024, device)
    times = time_query(query, {"peer": baseline.launch}, result, repeats)
    row |= summarise(times) | {"ratio": ratio_of(times["peer"], times["ours"])}
    return row | {"peer": f"wp.Bvh {baseline.constructor}"}


def time_query(query, others, result, repeats):
    """Return the times of a query and others, in turn; the timed answer must be the checked one."""
    times = time_in_turn({"ours": query.launch} | others, query.device, repeats)
    query.launch()
    known, again = (np.column_stack([found.pairs, found.count]).tolist() for found in (result, query.result()))
    if sorted(known) != sorted(again):
        raise RuntimeError("the timed query's answer differs from the checked one")
    return times


def check_alone(scene, result, pairs):
    """Ask some pairs by themselves, int (p, 2): their face pairs must be those among all others."""
    alone = scene.intersect(pairs, output="faces")
    asked = set(map(tuple, np.asarray(pairs).tolist()))
    expected = {(*pairs[pair], a, b) for pair, a, b in alone.faces.tolist()}
    chosen = [tuple(pair) in asked for pair in result.pairs.tolist()]
    rows = result.faces[np.isin(result.faces[:, 0], np.flatnonzero(chosen))]
    if {(*result.pairs[pair], a, b) for pair, a, b in rows.tolist()} != expected:
        raise RuntimeError(f"pairs {sorted(asked)} by themselves have other face pairs than among all others")


def run_worlds(device, model, world_count, repeats):
    """Return the row of many worlds of a few objects each: broad phase and narrow phase in one launch."""
    poses = random_poses(longest_side(model) / 2, OBJECTS * world_count)
    scene, query, result, row = make_query(device, model, poses, world_size=OBJECTS)
    check_worlds(scene, result, world_count, OBJECTS)
    row |= summarise(time_query(query, {"broad": query.broad_phase.launch}, result, repeats))
    return row | {"worlds": world_count, "objects": scene.object_count}


def check_worlds(scene, result, world_count, object_count):
    """Ask all pairs of objects of a few worlds: no worlds mix, and each has the face pairs that it has by itself."""
    world = result.pairs // object_count
    if (world[:, 0] != world[:, 1]).any():
        raise RuntimeError("the broad phase pairs objects of different worlds")
    every = np.stack(np.triu_indices(object_count, 1), 1)
    for number in range(0, world_count, max(1, world_count // CHECKED)):
        check_alone(scene, result, number * object_count + every)
