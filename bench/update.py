"""Time of an LOD change against its size, beside a full refit of the same state."""

import time

import numpy as np
import warp as wp

import warp_abtree as ab

from .shapes import knot


def run(device, face_target=60000, repeats=7):
    """Yield one row a share of the faces: k, nodes refitted, whether full, median time [ms] of `Scene.set_lods`."""
    device = wp.get_device(device)
    model = ab.Model.from_arrays(*knot(face_target), name="knot")
    scene = ab.Scene(device=device)
    scene.add(model)
    finest = model.lod_max
    for share in (0.0005, 0.001, 0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.5):
        other = model.lod_for(fraction=1 - share)
        times = []
        for _ in range(repeats):
            for lod in (other, finest):
                wp.synchronize_device(device)
                begin = time.perf_counter()
                stats = scene.set_lods([lod])
                wp.synchronize_device(device)
                times.append(1e3 * (time.perf_counter() - begin))
        yield {
            "device": device.name,
            "faces": model.face_count,
            "share": share,
            "k": int(stats.k[0]),
            "nodes_refitted": int(stats.nodes_refitted[0]),
            "full": bool(stats.full[0]),
            "ms": round(float(np.median(times)), 4),
        }
