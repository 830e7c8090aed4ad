"""Bound check: what the certified bound promises, over random configurations, judged by other means.

Surface distance: points of the original surface, its vertices among them, against the mesh at a random LOD, by libigl's
point-to-mesh distance. Proved apart: random LODs and poses about the first contact, the answer `within` both errors
beside the exact one at the finest LODs. Neither is a sample of the same code: libigl knows nothing of collapses, and
the finest answer nothing of errors.
"""

import numpy as np

from ...shapes import longest_side
from ...surfaces import sample_surface
from .workload import workloads

SURFACE_POINTS = 400
BACK_EVERY = 8  # configurations of which the way back, from the LOD to the original, is measured as well
ROUNDING = 1e-9  # of the size: distances are those of rounded points
CLOSENESS = (-0.5, 3.0)  # where poses lie, from the first contact outwards, in bounds


def random_lod(rng, model):
    """Return a LOD, the fraction of its vertex splits spread evenly over the logarithm."""
    return int(round(model.lod_max * 10.0 ** rng.uniform(-3, 0))) if rng.random() > 0.05 else 0


def farthest(igl, rng, mesh, other):
    """Return the largest distance of points of a mesh, half of them vertices, to another mesh."""
    vertices, faces = mesh
    points = sample_surface(rng, vertices, faces, SURFACE_POINTS // 2)
    points = np.concatenate([points, vertices[rng.choice(np.unique(faces), SURFACE_POINTS - len(points))]])
    square = igl.point_mesh_squared_distance(points, other[0], other[1].astype(np.int64))[0]
    return float(np.sqrt(np.asarray(square).max()))


def surface_rows(context, models):
    """Yield one row a model: how many LODs were tried, in how many a point lies beyond the bound, and how tight it is.

    used_* are the largest distances over the bound; back_max the same from the mesh at a LOD to the original, of which
    nothing is promised.
    """
    igl = context.library("igl")
    if igl is None:
        return
    count = -(-context.size(1200, 60) // len(models))
    rng = np.random.default_rng(11)
    for name, model in models.items():
        context.progress(f"{name}: surface distance")
        original, size = model.mesh_at(model.lod_max)[:2], longest_side(model)
        excess, tight, back = [], [], []
        for number in range(count):
            lod = random_lod(rng, model)
            coarse, bound = model.mesh_at(lod)[:2], model.error_at(lod) / size
            away = farthest(igl, rng, original, coarse) / size
            excess.append(away - bound)
            if bound > 0:
                tight.append(away / bound)
            if number % BACK_EVERY == 0 and bound > 0:
                back.append(farthest(igl, rng, coarse, original) / size / bound)
        row = {"case": "surface", "workload": name, "faces": model.face_count, "configurations": count}
        row |= {"points": count * SURFACE_POINTS, "violations": int((np.array(excess) > ROUNDING).sum())}
        yield row | {"used_median": float(np.median(tight)), "used_max": max(tight), "back_max": max(back)}


def apart_row(context, workload, rng):
    """Return a row: random LODs and poses, how many are proved apart, and in how many the originals intersect still.

    Poses lie about the first contact of the finest LODs. proved is the fraction of the poses without contact that the
    coarse meshes prove apart; coarse_missed that of those with contact in which the coarse meshes do not intersect.
    """
    pairs, poses_each = context.size((20, 16), (6, 8))
    apart, coarse_hits, truth = [], [], []
    for _ in range(pairs):
        lods = random_lod(rng, workload.a), random_lod(rng, workload.b)
        bound = workload.bound(lods)
        which = rng.integers(0, len(workload.motions), poses_each)
        along = workload.low[which] + rng.uniform(*CLOSENESS, poses_each) * max(bound, 1e-6 * workload.size)
        poses = workload.motions.poses(np.maximum(along, 0), which)
        coarse = workload.scene(lods, poses_each)
        apart.append(~coarse.near(poses, bound))
        coarse_hits.append(coarse.intersects(poses))
        truth.append(workload.finest.intersects(poses))
    apart, coarse_hits, truth = map(np.concatenate, (apart, coarse_hits, truth))
    row = {"case": "apart", "workload": workload.name, "configurations": len(truth)}
    row |= {"violations": int((apart & truth).sum()), "free": int((~truth).sum())}
    row["proved"] = float(apart[~truth].mean()) if row["free"] else None
    return row | {
        "met": int(truth.sum()),
        "coarse_missed": float((~coarse_hits[truth]).mean()) if truth.any() else None,
    }


def run(context):
    """Yield the rows of both checks."""
    models, found = {}, []
    rng = np.random.default_rng(12)
    for workload in workloads(context):
        found.append(apart_row(context, workload, rng))
        models |= {model.name: model for model in (workload.a, workload.b)}
    yield from surface_rows(context, models)
    yield from found
