"""Part `promises`: what the certified bound promises, over random configurations, judged by other means.

Surface distance: points of the original surface, its vertices among them, against the mesh at a random LOD, by libigl's
point-to-mesh distance. Proved apart: random LODs and poses about the first contact, the answer `within` both errors
beside the exact one at the finest LODs. Neither is a sample of the same code: libigl knows nothing of collapses, and
the finest answer nothing of errors.
"""

import numpy as np

from .tradeoff_subject import Stage, subjects

SURFACE_POINTS = 400
BACK_EVERY = 8  # configurations of which the way back, from the LOD to the original, is measured as well
ROUNDING = 1e-9  # of the size: distances are those of rounded points
CLOSENESS = (-0.5, 3.0)  # where poses lie, from the first contact outwards, in bounds


def random_lod(rng, model):
    """Return a LOD, the share of its vertex splits spread evenly over the logarithm."""
    return int(round(model.lod_max * 10.0 ** rng.uniform(-3, 0))) if rng.random() > 0.05 else 0


def sample_surface(rng, vertices, faces, count):
    """Return points of a mesh: half of them vertices, half anywhere on faces in proportion to their area, (n, 3)."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(faces), count // 2, p=area / area.sum())]
    weight = rng.dirichlet((1, 1, 1), count // 2)
    used = np.unique(faces)
    return np.concatenate([vertices[rng.choice(used, count - count // 2)], np.einsum("ni,nij->nj", weight, chosen)])


def mesh_distances(igl, points, vertices, faces):
    """Return the distance of each point to a mesh."""
    square = igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))[0]
    return np.sqrt(np.asarray(square))


def surface_rows(context, models):
    """Yield one row a model: how many LODs were tried, in how many a point lies beyond the bound, and how tight it is.

    excess is the largest distance less the bound [longest side]. back_* are distances from the mesh at a LOD to the
    original, of which nothing is promised.
    """
    igl = context.peer("igl")
    if igl is None:
        return
    count = -(-context.size(1200, 60) // len(models))
    rng = np.random.default_rng(11)
    for name, model in models.items():
        vertices, faces, _ = model.mesh_at(model.lod_max)
        size = float(np.ptp(vertices, axis=0).max())
        excess, tight, back = [], [], []
        for number in range(count):
            context.progress(f"{name}: surface distance", number, count)
            lod = random_lod(rng, model)
            coarse = model.mesh_at(lod)[:2]
            bound = model.error_at(lod) / size
            points = sample_surface(rng, vertices, faces, SURFACE_POINTS)
            away = mesh_distances(igl, points, *coarse).max() / size
            excess.append(away - bound)
            if bound > 0:
                tight.append(away / bound)
            if number % BACK_EVERY == 0 and bound > 0:
                points = sample_surface(rng, *coarse, SURFACE_POINTS)
                back.append(mesh_distances(igl, points, vertices, faces).max() / size / bound)
        row = {"case": "surface", "subject": name, "faces": model.face_count, "configurations": count}
        row |= {"points": count * SURFACE_POINTS, "violations": int((np.array(excess) > ROUNDING).sum())}
        row |= {"excess": max(excess), "used_median": float(np.median(tight)), "used_max": max(tight)}
        yield (
            row
            | {"back_configurations": len(back), "back_beyond": int((np.array(back) > 1).sum())}
            | {"back_max": max(back)}
        )


def apart_row(context, subject, rng):
    """Return a row: random LODs and poses, how many are proved apart, and in how many the originals meet all the same.

    Poses lie about the first contact of the finest LODs. proved is the share of the poses without contact that the
    coarse meshes prove apart; coarse_missed the share of those with contact in which the coarse meshes do not meet.
    """
    pairs, poses_each = context.size((20, 16), (6, 8))
    violations = proved = free = met = coarse_missed = 0
    for number in range(pairs):
        context.progress(f"{subject.name}: proved apart", number, pairs)
        lods = random_lod(rng, subject.a), random_lod(rng, subject.b)
        bound = subject.bound(lods)
        which = rng.integers(0, len(subject.motions), poses_each)
        along = subject.low[which] + rng.uniform(*CLOSENESS, poses_each) * max(bound, 1e-6 * subject.size)
        poses = subject.motions.poses(np.maximum(along, 0), which)
        coarse = Stage(subject, lods, poses_each)
        apart, truth = ~coarse.near(poses, bound), subject.stage.meets(poses)
        violations += int((apart & truth).sum())
        proved, free, met = proved + int((apart & ~truth).sum()), free + int((~truth).sum()), met + int(truth.sum())
        coarse_missed += int((~coarse.meets(poses) & truth).sum())
    row = {"case": "apart", "subject": subject.name, "configurations": pairs * poses_each, "violations": violations}
    row |= {"free": free, "proved": proved / free if free else None}
    return row | {"met": met, "coarse_missed": coarse_missed / met if met else None}


def run(context):
    """Yield the rows of both promises."""
    models, found = {}, []
    rng = np.random.default_rng(12)
    for subject in subjects(context):
        found.append(apart_row(context, subject, rng))
        for model in (subject.a, subject.b):
            models[model.name] = model
    yield from surface_rows(context, models)
    yield from found


def judge_promise(rows, case):
    """Return (held, finding) of a promise: never violated, over how many configurations."""
    found = [row for row in rows if row["case"] == case]
    if not found:
        return None, "Not measured."
    total = sum(row["configurations"] for row in found)
    violations = sum(row["violations"] for row in found)
    return violations == 0, f"{violations} violations in {total:,} random configurations."
