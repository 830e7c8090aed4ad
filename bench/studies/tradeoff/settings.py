"""Cost and error of the other settings: precision, and a margin around the surfaces.

Boxes have no setting of their own: their margin covers rounding, and no answer depends on it. What widens them on
purpose is `within=`: pairs that are not proved farther apart than a distance count as intersecting, so that a coarse
LOD with `within` of both errors misses nothing. It is measured here as the margin of the answer.
"""

import numpy as np

from ...verify import count_differences
from .workload import judge_answers, judge_contact, workloads

PRECISIONS = ("exact", "float32")
PRECISION_FRACTIONS = (0.1, 1)
MARGIN_FRACTIONS = (0.02, 0.1, 0.5)
FACTORS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of both errors
COINCIDENT_FACES = 25_000  # larger meshes are not laid on themselves: a million face pairs a pose
COINCIDENT_ULPS = (0, 1, -3, 50)


def coincident_poses(size):
    """Return poses that make a mesh coincide with itself, some off by a few units in the last place of its size."""
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(COINCIDENT_ULPS), 1))
    poses[:, 0] = np.array(COINCIDENT_ULPS) * np.spacing(size)
    return poses


def precision_rows(context, workload, scenes):
    """Yield one row a fraction of faces, kind of poses and precision: answers beside those of "exact", and times."""
    groups = {"apart to deep": workload.timed_poses(), "at first contact": workload.poses[workload.offset == 0]}
    if workload.a is workload.b and workload.a.face_count <= COINCIDENT_FACES:
        groups["coincident meshes"] = coincident_poses(workload.size)
    for value in PRECISION_FRACTIONS:
        for group, poses in groups.items():
            queries = {p: scenes[value].query(poses, "faces", precision=p) for p in PRECISIONS}
            found = {precision: query.run() for precision, query in queries.items()}  # grows where there is no room
            for result in found.values():
                result.check()
            times = context.time_launches({precision: query.launch for precision, query in queries.items()})
            exact = found["exact"]
            for precision in PRECISIONS:
                missed, invented = count_differences(found[precision].faces, exact.faces)
                row = {"case": "precision", "workload": workload.name, "value": value, "poses_kind": group}
                row |= {"setting": precision} | judge_answers(found[precision].any, exact.any)
                row |= {"hits": len(exact.faces), "faces_missed": missed, "faces_invented": invented}
                row["faces_us"] = 1e3 * times[precision] / len(poses)
                yield row | {"cost": times[precision] / times["exact"]}


def margin_rows(context, workload, scenes):
    """Yield one row a fraction of faces and margin: pairs not proved apart, taken as intersecting, beside the truth."""
    poses = workload.timed_poses()
    for value in context.size(MARGIN_FRACTIONS, MARGIN_FRACTIONS[1:2]):
        scene, bound = scenes[value], workload.bound(workload.lods(fraction=value))
        queries = {factor: scene.query(poses, "any", within=factor * bound) for factor in FACTORS}
        found = {factor: query.run() for factor, query in queries.items()}
        times = context.time_launches({factor: query.prove_apart for factor, query in queries.items()})
        plain = scene.query(poses, "any")
        plain.run()
        alone = context.time_launches({"any": plain.launch})["any"]
        for factor in FACTORS:
            near = ~found[factor].apart[: len(workload.poses)]
            error = workload.first_contact(lambda at, scene=scene, d=factor * bound: scene.near(at, d))
            row = {"case": "margin", "workload": workload.name, "value": value, "factor": factor}
            row |= {"margin": factor * bound / workload.size} | judge_answers(near, workload.truth)
            row |= judge_contact(error)
            yield row | {"us": 1e3 * times[factor] / len(poses), "cost": times[factor] / alone}


def run(context):
    """Yield the rows of both settings, workload by workload."""
    for workload in workloads(context):
        values = {*PRECISION_FRACTIONS, *context.size(MARGIN_FRACTIONS, ())}
        scenes = {value: workload.scene(workload.lods(fraction=value)) for value in values}
        yield from precision_rows(context, workload, scenes)
        yield from margin_rows(context, workload, scenes)
