"""All intersecting face pairs of many posed pairs of one knot, beside the wp.Bvh peer."""

import numpy as np
import warp as wp

import warp_abtree as ab

from .peer import BvhPeer
from .shapes import knot, pair_poses
from .timing import time_in_turn


def run(device, pair_counts=(1, 64, 1024, 8192), distances=(0.9, 0.2), repeats=15):
    """Yield one row a case: pairs, distance, hits, node tests, median and p95 [ms] of ours and of the peer, ratio."""
    device = wp.get_device(device)
    vertices, faces = knot(5000)
    model = ab.Model.from_arrays(vertices, faces, name="knot 4,794")
    for pair_count in pair_counts:
        for distance in distances:
            if pair_count > 1024 and (distance < 0.9 or not device.is_cuda):
                continue  # minutes
            poses = pair_poses(pair_count, distance)
            scene = ab.Scene(device=device)
            for pose in poses:
                scene.add(model, pose=pose)
            pairs = np.arange(2 * pair_count).reshape(-1, 2)
            whole = scene.intersect(pairs, output="faces")
            query = ab.Query(scene, output="faces", pairs=pairs, capacity=max(1, len(whole.faces)))
            peer = BvhPeer(vertices, faces, poses, 4 * len(whole.faces) + 1024, device)
            times = time_in_turn({"ours": query.launch, "peer": peer.launch}, device, repeats)
            again = query.result()
            again.check()
            if not np.array_equal(again.faces, whole.faces):
                raise RuntimeError("the timed query's answer differs from the checked one")
            row = {"device": device.name, "pairs": pair_count, "distance": distance, "hits": len(whole.faces)}
            row["node_tests"] = int(again.node_tests.sum(dtype=np.int64))
            row["triangle_tests"] = int(again.triangle_tests.sum(dtype=np.int64))
            row["peer_hits"] = int(peer.total.numpy()[0])
            for name, values in times.items():
                row[f"{name}_ms"] = round(float(np.median(values)), 4)
                row[f"{name}_p95_ms"] = round(float(np.percentile(values, 95)), 4)
            row["ratio"] = round(row["peer_ms"] / row["ours_ms"], 2)
            yield row
