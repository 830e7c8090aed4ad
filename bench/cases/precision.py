"""What "float32" saves and gets wrong on whole meshes: all face pairs of one batch, in turn with "exact"."""

import warp as wp

import warp_abtree as ab

from ..shapes import knot, pair_poses, scene_of_pairs
from ..timing import ratio_of, summarise, time_in_turn
from ..verify import count_differences

PRECISIONS = ("exact", "float32")
FULL = {"faces": 5000, "pairs": 256, "coincident": 16, "repeats": 11}
QUICK = {"faces": 300, "pairs": 3, "coincident": 1, "repeats": 1}


def run(device, quick=False):
    """Yield one row a scene: hits, fractions of face pairs that reach float64 and exact signs, face pairs that float32
    misses and invents, and times of a launch [ms]."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    scenes = {f"knots, centres {distance} apart": pair_poses(sizes["pairs"], distance) for distance in (0.9, 0.2)}
    scenes["coincident knots, any rotation"] = pair_poses(sizes["coincident"], 0.0)
    scenes["coincident knots, any rotation"][1::2] = scenes["coincident knots, any rotation"][::2]
    for name, poses in scenes.items():
        scene, pairs = scene_of_pairs(device, model, poses)
        queries = {p: ab.Query(scene, output="faces", pairs=pairs, precision=p) for p in PRECISIONS}
        found = {precision: query.run() for precision, query in queries.items()}
        times = time_in_turn({p: query.launch for p, query in queries.items()}, device, sizes["repeats"])
        exact = found["exact"]
        tests = exact.triangle_tests.sum()
        row = {"device": device.name, "scene": name, "hits": len(exact.faces), "triangle_tests": int(tests)}
        row["to_float64"] = float(f"{exact.float64_tests.sum() / tests:.3g}")
        row["to_exact"] = float(f"{exact.exact_tests.sum() / tests:.3g}")
        row["float32_missed"], row["float32_invented"] = count_differences(found["float32"].faces, exact.faces)
        row |= summarise(times)
        yield row | {"exact_to_float32": ratio_of(times["exact"], times["float32"])}
