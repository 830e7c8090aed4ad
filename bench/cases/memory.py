"""Bytes that a scene's arrays hold: a face of a model, a face of a tree state, an object, a pair; states shared."""

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

from ..shapes import knot_model, pair_poses

FULL = {"faces": (200, 5000, 60000, 1_000_000), "knots": (1000, 2000, 4000), "balls": (3, 4), "objects": 10000}
QUICK = {"faces": (200,), "knots": (200,), "balls": (1,), "objects": 32}


def count_bytes(holder):
    """Return the bytes of all arrays among an object's attributes."""
    return sum(value.capacity for value in vars(holder).values() if isinstance(value, wp.array))


def held_mib(scene, query=None) -> float:
    """Return what the arrays of a scene, and of a query over it, hold [MiB]; the tree of the broad phase left out."""
    total = sum(map(count_bytes, scene.batch().pools))
    if query is not None:
        total += count_bytes(query) + count_bytes(query.hits)
        if query.broad_phase is not None:
            # Its pairs are the query's.
            total += count_bytes(query.broad_phase) - query.pairs.capacity - query.pair_count.capacity
    return round(total / 2**20, 3)


def used_memory(device) -> dict:
    """Return columns of memory [MiB] in use on a CUDA device: Warp's pool, and all that is taken; none on the CPU."""
    if device.is_cpu:
        return {}
    wp.synchronize_device(device)
    taken = device.total_memory - device.free_memory
    pool = wp.get_mempool_used_mem_current(device) if wp.is_mempool_enabled(device) else None
    return {"pool_mib": None if pool is None else round(pool / 2**20, 1), "taken_mib": round(taken / 2**20, 1)}


def memory_columns(scene, query=None) -> dict:
    """Return the columns of a scene's memory [MiB], and of a query's over it."""
    return {"arrays_mib": held_mib(scene, query)} | used_memory(scene.device)


def scenes(device, sizes, folder):
    """Yield (name, scene, faces of all models)."""
    for size in sizes["faces"]:
        model = knot_model(size, folder)
        scene = ab.Scene(device)
        scene.add(model)
        scene.add(model, (0.5, 0, 0, 0, 0, 0, 1))
        yield f"a knot of {model.face_count:,} faces, twice", scene, model.face_count
    models = [knot_model(size, folder) for size in sizes["knots"]]
    for subdivisions in sizes["balls"]:
        ball = trimesh.creation.icosphere(subdivisions)
        models.append(ab.Model.from_arrays(ball.vertices, ball.faces))
    scene = ab.Scene(device)
    for i, pose in enumerate(pair_poses(sizes["objects"] // 2, 3.0)):
        model = models[i % len(models)]
        scene.add(model, pose, lod=model.lod_max * (i // len(models) % 8 + 1) // 8)
    name = f"{scene.object_count:,} objects of {len(models)} models at 8 LODs"
    yield name, scene, sum(model.face_count for model in models)


def run(device, quick=False, models=None):
    """Yield one row a scene: objects, states, and bytes: of the models and the states a face, an object, a pair."""
    device = wp.get_device(device)
    for name, scene, faces in scenes(device, QUICK if quick else FULL, models):
        states = scene.batch().states
        pairs = np.stack([np.arange(scene.object_count - 1), np.arange(1, scene.object_count)], 1)
        query = ab.Query(scene, "any", pairs=pairs)
        pair_bytes = (query.pairs.capacity + query.pair_poses.capacity + count_bytes(query.hits)) / len(pairs)
        state_faces = sum(scene.models[slot.model].face_count for slot in states.slots)
        sizes = [count_bytes(pool) for pool in scene.batch().pools]
        yield {
            "device": device.name,
            "scene": name,
            "objects": scene.object_count,
            "states": len(states.slots),
            "model_bytes_a_face": round(sizes[0] / faces, 1),
            "state_bytes_a_face": round(sizes[1] / state_faces, 1),
            "object_bytes": round(sizes[2] / scene.object_count, 1),
            "pair_bytes": round(pair_bytes, 1),
            "all_mib": round(sum(sizes) / 2**20, 2),
        }
