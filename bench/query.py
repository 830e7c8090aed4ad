"""All intersecting face pairs of many posed pairs of one knot, beside the wp.Bvh peer and Newton, where installed."""

import gc
import time

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing

from . import newton_peer
from .memory import held_mib
from .peer import BvhPeer, count_differences, find_constructor
from .peers import load_oracle
from .roofline import find_peaks, roofline, used_memory
from .shapes import knot, pair_poses
from .timing import summarise, time_in_turn, time_rounds, time_wall

FULL = {"faces": 5000, "pairs": (1, 64, 1024, 8192), "distances": (0.9, 0.2), "repeats": 15}
QUICK = {"faces": 300, "pairs": (1, 4), "distances": (0.2,), "repeats": 3}
# More than these take minutes on the CPU, or where the meshes are nearer than this.
PAIRS_MAX_CLOSE = 1024
FAR = 0.9
NEWTON_PAIRS_MAX = {"cuda": 1024, "cpu": 64}
JUDGED = 300  # face pairs that the oracle is asked about


def run(device, quick=False):
    """Yield one row a case: what was asked, what was found, times of ours and of each peer, memory and the roofline.

    first_s is the first run: it compiles or loads kernels and grows buffers. ours and peer are launches, whose face
    pairs lie on the device in no order; result and peer_result what it takes to bring them to the host and sort them
    there; sorted and peer_sorted both together. ratio is the peer's launch over ours; on the CPU ours has
    all cores, and one_core and one_core_ratio are of both on one. Errors are counted against the exact answer; judged
    says of how many face pairs on which the peer differs the exact oracle of the tests was asked, ours_wrong in how
    many it sides with the peer. Memory is that of scene and query, before there are peers.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    vertices, faces = knot(sizes["faces"])
    model = ab.Model.from_arrays(vertices, faces, name=f"knot {len(faces):,}")
    peaks = find_peaks(device)
    constructor = find_constructor(vertices, faces, pair_poses(min(64, max(sizes["pairs"])), 0.9), device)
    for pair_count in sizes["pairs"]:
        for distance in sizes["distances"]:
            limit = PAIRS_MAX_CLOSE if device.is_cpu or distance < FAR else max(sizes["pairs"])
            if pair_count > limit:
                continue
            poses = pair_poses(pair_count, distance)
            yield run_case(device, model, vertices, faces, poses, distance, constructor, peaks, sizes["repeats"])


def run_case(device, model, vertices, faces, poses, distance, constructor, peaks, repeats):
    """Return the row of one batch of pairs."""
    gc.collect()  # scenes and their queries hold each other
    pair_count = len(poses) // 2
    scene = ab.Scene(device=device)
    for pose in poses:
        scene.add(model, pose=pose)
    pairs = np.arange(2 * pair_count).reshape(-1, 2)
    begin = time.perf_counter()
    whole = scene.intersect(pairs, output="faces")
    first = time.perf_counter() - begin
    query = ab.Query(scene, output="faces", pairs=pairs, capacity=max(1, len(whole.faces)))
    memory = {"arrays_mib": held_mib(scene, query)} | used_memory(device)
    peer = BvhPeer(vertices, faces, poses, 4 * len(whole.faces) + 1024, device, constructor)
    row = {"device": device.name, "faces": len(faces), "pairs": pair_count, "distance": distance}
    row["hits"] = len(whole.faces)
    for name in ("node_tests", "triangle_tests", "float64_tests", "exact_tests"):
        row[name] = int(getattr(whole, name).sum(dtype=np.int64))
    row["first_s"] = round(first, 3)
    row["peer"] = f"wp.Bvh {constructor}"
    refused = refuse_newton(device, pair_count)
    newton, skipped = newton_peer.make_peers(vertices, faces, poses, len(whole.faces), device, refused)
    launches = {"ours": query.launch, "peer": peer.launch} | {name: other.launch for name, other in newton.items()}
    times = time_in_turn(launches, device, repeats)
    again = query.result()
    again.check()
    if not np.array_equal(again.faces, whole.faces):
        raise RuntimeError("the timed query's answer differs from the checked one")
    found = peer.result()
    row["peer_hits"] = len(found)
    row["peer_missed"], row["peer_invented"] = count_differences(found, whole.faces)
    row |= judge(found, whole.faces, model, poses)
    for name, other in newton.items():
        row |= {f"{name}_{key}": value for key, value in other.compare(whole.any).items()}
    for name, values in times.items():
        row |= summarise(name, values)
        if name != "ours":
            ratio = "ratio" if name == "peer" else f"{name}_ratio"
            row[ratio] = round(float(np.median(values) / np.median(times["ours"])), 2)
    if device.is_cpu:
        row |= time_one_core(query, peer, device, repeats)
    row |= {f"{name}_skipped": why for name, why in skipped.items()}
    row |= time_results(query, peer, device, min(repeats, 3))
    row["sorted_ms"] = round(row["ours_ms"] + row["result_ms"], 4)
    row["peer_sorted_ms"] = round(row["peer_ms"] + row["peer_result_ms"], 4)
    row["sorted_ratio"] = round(row["peer_sorted_ms"] / row["sorted_ms"], 2)
    return row | memory | roofline(again, row["ours_ms"], peaks)


def time_one_core(query, peer, device, repeats):
    """Return columns of launches of both on one core: the time [ms] that the thread ran, and the peer's over ours."""
    launches = {"one_core": query.launch, "peer_one_core": peer.launch}
    with testing.regime(cpu_threads=1):
        times = time_in_turn(launches, device, repeats, time.thread_time)
    ratio = round(float(np.median(times["peer_one_core"]) / np.median(times["one_core"])), 2)
    return summarise("one_core", times["one_core"]) | {"one_core_ratio": ratio}


def judge(found, ours, model, poses):
    """Return columns: how many face pairs on which the peer differs the exact oracle judged, in how many ours is wrong.

    Raises:
        RuntimeError: One is.
    """
    oracle = load_oracle()
    if oracle is None:
        return {"judged": 0, "ours_wrong": None}
    theirs, mine = (set(map(tuple, rows.tolist())) for rows in (found, ours))
    disputed = sorted(mine ^ theirs)
    disputed = disputed[:: max(1, len(disputed) // JUDGED)]
    vertices, faces, _ = model.mesh_at(model.lod_max)
    wrong = 0
    for pair, a, b in disputed:
        points = oracle.into_frame_of_a(vertices[faces[b]], poses[2 * pair], poses[2 * pair + 1])
        meets = oracle.triangles_intersect(vertices[faces[a]], points)
        wrong += bool(meets) != ((pair, a, b) in mine)
    if wrong:
        raise RuntimeError(f"{wrong} of {len(disputed)} face pairs on which the peer differs are errors of ours")
    return {"judged": len(disputed), "ours_wrong": wrong}


def refuse_newton(device, pair_count) -> str | None:
    """Return why Newton is not asked about so many pairs, None where it is."""
    limit = NEWTON_PAIRS_MAX["cuda" if device.is_cuda else "cpu"]
    return None if pair_count <= limit else f"more than {limit} pairs take minutes"


def time_results(query, peer, device, repeats):
    """Return columns of the time [ms] to bring the last launch's face pairs to the host and sort them there."""
    runs = {"result": time_wall(query.result, device), "peer_result": time_wall(peer.result, device)}
    row = {}
    for name, values in time_rounds(runs, repeats).items():
        row |= summarise(name, values)
    return row
