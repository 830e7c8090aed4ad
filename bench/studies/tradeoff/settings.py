"""Cost and error of the other settings: precision, output, and a margin around the surfaces.

Boxes have no setting of their own: their margin covers rounding, and no answer depends on it. What widens them on
purpose is `within=`: pairs that are not proved farther apart than a distance count as intersecting, so that a coarse
LOD with `within` of both errors misses nothing. It is measured here as the margin of the answer.
"""

import numpy as np

import warp_abtree as ab

from ...verify import count_differences
from .workload import judge_answers, judge_contact, workloads

PRECISIONS = ("exact", "float32")
OUTPUTS = ("any", "count", "faces", "contacts")
FRACTIONS = (0.01, 0.05, 0.2, 1)
PRECISION_FRACTIONS = (0.1, 1)
MARGIN_FRACTIONS = (0.02, 0.1, 0.5)
FACTORS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of both errors
COINCIDENT_FACES = 25_000  # larger meshes are not laid on themselves: a million face pairs a pose
COINCIDENT_ULPS = (0, 1, -3, 50)


def make_query(scene, poses, output, **options):
    """Return a query of placed poses, whose first run makes room for what it finds."""
    scene.place(poses)
    pairs = scene.pairs[: len(poses)]
    return (
        ab.ContactQuery(scene.scene, pairs) if output == "contacts" else ab.Query(scene.scene, output, pairs, **options)
    )


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
            queries = {p: make_query(scenes[value], poses, "faces", precision=p) for p in PRECISIONS}
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


def output_rows(context, workload, scenes):
    """Yield one row a fraction of faces and output: time and tests of one pose."""
    poses, finest = workload.timed_poses(), None
    for value in sorted(context.size(FRACTIONS, PRECISION_FRACTIONS), reverse=True):
        scene = scenes[value]
        queries = {output: make_query(scene, poses, output) for output in OUTPUTS}
        found = {output: query.run() for output, query in queries.items()}
        if not all(np.array_equal(result.any, found["any"].any) for result in found.values()):
            raise RuntimeError("outputs differ in which poses intersect")
        times = context.time_launches({output: query.launch for output, query in queries.items()})
        finest = finest or times
        for output, result in found.items():
            row = {"case": "output", "workload": workload.name, "value": value, "setting": output}
            row |= {"us": 1e3 * times[output] / len(poses), "cost": times[output] / times["any"]}
            row |= {"of_finest": times[output] / finest[output], "node_tests": float(result.node_tests.mean())}
            yield row | {"triangle_tests": float(result.triangle_tests.mean())}


def margin_rows(context, workload, scenes):
    """Yield one row a fraction of faces and margin: pairs not proved apart, taken as intersecting, beside the truth."""
    poses = workload.timed_poses()
    for value in context.size(MARGIN_FRACTIONS, MARGIN_FRACTIONS[1:2]):
        scene, bound = scenes[value], workload.bound(workload.lods(fraction=value))
        queries = {factor: make_query(scene, poses, "any", within=factor * bound) for factor in FACTORS}
        found = {factor: query.run() for factor, query in queries.items()}
        times = context.time_launches({factor: query.prove_apart for factor, query in queries.items()})
        plain = make_query(scene, poses, "any")
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
    """Yield the rows of all three settings, workload by workload."""
    for workload in workloads(context):
        values = {*PRECISION_FRACTIONS, *context.size(FRACTIONS + MARGIN_FRACTIONS, ())}
        scenes = {value: workload.scene(workload.lods(fraction=value)) for value in values}
        for rows in (precision_rows, output_rows, margin_rows):
            yield from rows(context, workload, scenes)
