"""Contact regions, the segments of the contacts of each pose, beside those of the exact answer; averaged normals.

Segments are sampled every `SPACING` of the size. The distance of a sample to the other region is that to the nearest
of the segments that hold the other region's four nearest samples.
"""

from dataclasses import dataclass

import numpy as np

SPACING = 1 / 300
NEAREST = 4
ROUNDING = 1e-12  # of the size: distances below are those of rounded samples
TOLERANCE = 0.01  # of the size: a contact farther than this from the other region has no counterpart there


@dataclass
class Regions:
    """The contact regions of many poses."""

    ends: np.ndarray  # segments, float64 (k, 2, 3) [sizes]
    pose: np.ndarray  # of each segment, int (k,)
    sample: np.ndarray  # float64 (n, 3) [sizes]
    of: np.ndarray  # segment of each sample, int (n,)
    weight: np.ndarray  # length that a sample stands for, (n,) [sizes]
    poses: int  # their number


def make_regions(contacts, poses, size):
    """Return the regions of an `ab.Result.contacts` of a number of poses."""
    ends = np.stack([contacts["p0"], contacts["p1"]], 1).astype(float) / size
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    count = np.maximum(1, np.ceil(length / SPACING)).astype(int)
    of = np.repeat(np.arange(len(ends)), count)
    number = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    along = ((number + 0.5) / count[of])[:, None]
    sample = ends[of, 0] * (1 - along) + ends[of, 1] * along
    return Regions(ends, contacts["pair"].astype(int), sample, of, length[of] / count[of], poses)


def segment_distance(points, ends):
    """Return the distances of points (..., 3) to segments (..., 2, 3)."""
    p, d = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    square = (d * d).sum(-1)
    along = ((points - p) * d).sum(-1) / np.where(square > 0, square, 1)
    return np.linalg.norm(points - p - np.clip(along, 0, 1)[..., None] * d, axis=-1)


def distances(points, pose, other: Regions):
    """Return the distance of each point to the region of its pose [sizes]; infinite where that is empty."""
    from scipy.spatial import cKDTree

    found = np.full(len(points), np.inf)
    if not len(points) or not len(other.sample):
        return found
    # A fourth coordinate keeps the poses apart, so that one tree serves all.
    spread = 10 * (1 + max(np.ptp(points, axis=0).max(), np.ptp(other.sample, axis=0).max()))
    tree = cKDTree(np.column_stack([other.sample, spread * other.pose[other.of]]))
    wanted = np.isin(pose, other.pose)
    k = min(NEAREST, len(other.sample))
    _, near = tree.query(np.column_stack([points, spread * pose])[wanted], k=k, workers=-1)
    near = other.of[near.reshape(-1, k)]
    reach = segment_distance(points[wanted][:, None], other.ends[near])
    reach[other.pose[near] != pose[wanted][:, None]] = np.inf
    reach = reach.min(1)
    found[wanted] = np.where(reach < ROUNDING, 0.0, reach)
    return found


def _per_pose(values, weights, pose, poses):
    """Return the weighted mean and the largest value of each pose, NaN where there is none; equal weights if all 0."""
    total = np.bincount(pose, weights, poses)
    weights = np.where(total[pose] > 0, weights, 1.0)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(pose, weights * values, poses) / np.bincount(pose, weights, poses)
    largest = np.full(poses, -np.inf)
    np.maximum.at(largest, pose, values)
    return mean, np.where(np.isfinite(largest), largest, np.nan)


def compare_regions(found: Regions, truth: Regions):
    """Return columns: contacts missed and invented (fractions), mean and Hausdorff distance of the regions [sizes].

    The distances are of poses where both regions are there: the mean over poses of the mean distance (of samples of
    either region to the other, the larger of both) and of the Hausdorff distance, and the largest of the latter.
    """
    row, means, largest = {}, [], []
    for name, one, other in (("missed", truth, found), ("invented", found, truth)):
        away = distances(one.ends.mean(1), one.pose, other)
        row[f"contacts_{name}"] = float((away > TOLERANCE).mean()) if len(away) else None
    every = np.arange(truth.poses)
    both = np.isin(every, truth.pose) & np.isin(every, found.pose)
    for one, other in ((found, truth), (truth, found)):
        pose = one.pose[one.of]
        use = both[pose]
        reach = distances(one.sample[use], pose[use], other)
        mean, most = _per_pose(reach, one.weight[use], pose[use], truth.poses)
        means.append(mean[both])
        largest.append(most[both])
    if both.any():
        mean, most = np.maximum(*means), np.maximum(*largest)
        row |= {"region_mean": float(mean.mean()), "region_hausdorff": float(most.mean())}
        row["region_hausdorff_max"] = float(most.max())
    return row


def resultants(contacts, poses):
    """Return the length of the mean of each pose's normals, weighted as `pair_contacts` is, (n,); 0 without contacts.

    1 where all normals agree; near 0 they cancel, and the direction of their mean says little.
    """
    weight = np.linalg.norm(contacts["p1"] - contacts["p0"], axis=1)
    total = np.bincount(contacts["pair"], weight, poses)
    sums = [np.bincount(contacts["pair"], weight * contacts["normal"][:, i], poses) for i in range(3)]
    return np.divide(np.linalg.norm(sums, axis=0), total, out=np.zeros(poses), where=total > 0)


def compare_normals(found, truth, clear):
    """Return columns: angle between the averaged normals of two `pair_contacts` [degrees], over poses where both have
    contacts, and over those of them whose normals agree (`clear`, bool (n,))."""
    cosine = (found["normal"] * truth["normal"]).sum(1)
    sine = np.linalg.norm(np.cross(found["normal"], truth["normal"]), axis=1)
    angle = np.degrees(np.arctan2(sine, cosine))
    both, row = (found["count"] > 0) & (truth["count"] > 0), {}
    for name, kept in (("normal", both), ("normal_clear", both & clear)):
        row[f"{name}_mean"] = float(angle[kept].mean()) if kept.any() else None
        row[f"{name}_p95"] = float(np.percentile(angle[kept], 95)) if kept.any() else None
        row[f"{name}_poses"] = int(kept.sum())
    return row
