"""What each precision costs and gets wrong on whole meshes: all face pairs of one batch, in turn in one process."""

import math

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

from .shapes import knot, pair_poses
from .timing import summarise, time_in_turn

PRECISIONS = ("exact", "float32")
FULL = {"faces": 5000, "subdivisions": 4, "pairs": 256, "laid": 16, "repeats": 11}
QUICK = {"faces": 300, "subdivisions": 1, "pairs": 3, "laid": 1, "repeats": 1}


def scenes(sizes):
    """Yield (name, model, poses of objects 2p and 2p + 1)."""
    tangle = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for distance in (0.9, 0.2):
        yield f"knots, centres {distance} apart", tangle, pair_poses(sizes["pairs"], distance)
    ball = trimesh.creation.icosphere(sizes["subdivisions"])
    model = ab.Model.from_arrays(0.5 * ball.vertices, ball.faces, name="ball")
    yield "balls, centres 0.7 apart", model, pair_poses(sizes["pairs"], 0.7)
    poses = pair_poses(sizes["laid"], 0.9)
    poses[1::2] = poses[::2]
    yield "a knot laid on itself, turned", tangle, poses
    poses = poses.copy()
    poses[:] = [0, 0, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)]
    yield "a knot laid on itself, a quarter turn", tangle, poses


def count_differences(faces, truth):
    """Return how many rows of sorted face pairs are missed and how many invented."""
    rows, kept = (set(map(tuple, found.tolist())) for found in (truth, faces))
    return len(rows - kept), len(kept - rows)


def run(device, quick=False):
    """Yield one row a scene: hits, share of face pairs that reach float64 and expansions, and for each precision pairs
    missed, pairs invented and the time of a launch [ms], and what exact costs beside float32."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    for name, model, poses in scenes(sizes):
        scene = ab.Scene(device=device)
        for pose in poses:
            scene.add(model, pose=pose)
        pairs = np.arange(len(poses)).reshape(-1, 2)
        queries, found = {}, {}
        for precision in PRECISIONS:
            query = ab.Query(scene, output="faces", pairs=pairs, precision=precision)
            found[precision] = query.run()
            queries[precision] = query
        times = time_in_turn({p: query.launch for p, query in queries.items()}, device, sizes["repeats"])
        exact = found["exact"]
        asked = exact.triangle_tests.sum()
        row = {"device": device.name, "scene": name, "hits": len(exact.faces), "triangle_tests": int(asked)}
        row["to_float64"] = float(f"{exact.float64_tests.sum() / asked:.3g}")
        row["to_exact"] = float(f"{exact.exact_tests.sum() / asked:.3g}")
        for precision in PRECISIONS:
            missed, invented = count_differences(found[precision].faces, exact.faces)
            if precision != "exact":
                row[f"{precision}_missed"], row[f"{precision}_invented"] = missed, invented
            row |= summarise(precision, times[precision])
        row["exact_to_float32"] = round(float(np.median(times["exact"]) / np.median(times["float32"])), 2)
        yield row
