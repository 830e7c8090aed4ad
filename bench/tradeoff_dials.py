"""Part `dials`: what the other dials cost and get wrong: precision, what is asked, and a distance around the surfaces.

Boxes have no dial of their own: their margin covers rounding, and no answer depends on it. What widens them on purpose
is `within=`: pairs that are not proved farther apart than a distance count as meeting, so that a coarse LOD with
`within` of both errors misses nothing. It is measured here as the margin of the answer.
"""

import numpy as np

import warp_abtree as ab

from .peer import count_differences
from .tradeoff_subject import Stage, judge_answers, judge_contact, subjects, time_launches

PRECISIONS = ("exact", "float32")
OUTPUTS = ("any", "count", "faces", "contacts")
FRACTIONS = (0.01, 0.05, 0.2, 1)
PRECISION_FRACTIONS = (0.1, 1)
MARGIN_FRACTIONS = (0.02, 0.1, 0.5)
FACTORS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of both errors
LAID_FACES = 25_000  # larger meshes are not laid on themselves: a million face pairs a pose
LAID_ULPS = (0, 1, -3, 50)


def make_query(stage, poses, output, capacity=0, **options):
    """Return a query of placed poses that has room for what it finds."""
    pairs = stage.pairs[: len(poses)]
    stage.place(poses)
    if output == "contacts":
        query = ab.ContactQuery(stage.scene, pairs, capacity=max(1024, capacity), **options)
    elif output == "faces":
        query = ab.Query(stage.scene, "faces", pairs, capacity=max(1024, capacity), **options)
    else:
        query = ab.Query(stage.scene, output, pairs, **options)
    return query


def laid_poses(size):
    """Return poses that lay a mesh on itself, some of them off by a few units in the last place of its size."""
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(LAID_ULPS), 1))
    poses[:, 0] = np.array(LAID_ULPS) * np.spacing(size)
    return poses


def precision_rows(context, subject, stages):
    """Yield one row a share of the faces, kind of poses and precision: answers beside those of "exact", and times."""
    groups = {"apart to deep": subject.tiled(), "at first contact": subject.poses[subject.offset == 0]}
    if subject.a is subject.b and subject.a.face_count <= LAID_FACES:
        groups["laid on itself"] = laid_poses(subject.size)
    for value in PRECISION_FRACTIONS:
        for group, poses in groups.items():
            queries, found = {}, {}
            for precision in PRECISIONS:
                query = make_query(stages[value], poses, "faces", 64 * len(poses), precision=precision)
                found[precision] = query.run()  # grows where there is no room
                found[precision].check()
                queries[precision] = query.launch
            times = time_launches(context, queries)
            exact = found["exact"]
            for precision in PRECISIONS:
                missed, invented = count_differences(found[precision].faces, exact.faces)
                row = {"case": "precision", "subject": subject.name, "value": value, "poses_kind": group}
                row |= {"setting": precision} | judge_answers(found[precision].any, exact.any)
                row |= {"hits": len(exact.faces), "faces_missed": missed, "faces_invented": invented}
                row |= {"faces_us": 1e3 * times[precision] / len(poses)}
                yield row | {"cost": times[precision] / times["exact"]}


def output_rows(context, subject, stages):
    """Yield one row a share of the faces and output: time and tests of one pose."""
    poses = subject.tiled()
    finest = None
    for value in sorted(context.size(FRACTIONS, PRECISION_FRACTIONS), reverse=True):
        stage = stages[value]
        hits = int(stage.ask(subject.poses, "count").count.sum()) * (len(poses) // len(subject.poses))
        queries = {output: make_query(stage, poses, output, hits) for output in OUTPUTS}
        found = {output: query.run() for output, query in queries.items()}
        for result in found.values():
            result.check()
            if not np.array_equal(result.any, found["any"].any):
                raise RuntimeError("outputs differ in which poses meet")
        times = time_launches(context, {output: query.launch for output, query in queries.items()})
        finest = finest or times
        for output in OUTPUTS:
            row = {"case": "output", "subject": subject.name, "value": value, "setting": output}
            row |= {"us": 1e3 * times[output] / len(poses), "cost": times[output] / times["any"]}
            row["of_finest"] = times[output] / finest[output]
            row["node_tests"] = float(found[output].node_tests.mean())
            yield row | {"triangle_tests": float(found[output].triangle_tests.mean())}


def margin_rows(context, subject, stages):
    """Yield one row a share of the faces and margin: pairs not proved apart, taken as meeting, beside the truth."""
    poses = subject.tiled()
    for value in context.size(MARGIN_FRACTIONS, MARGIN_FRACTIONS[1:2]):
        stage, lods = stages[value], subject.lods(fraction=value)
        bound = subject.bound(lods)
        queries = {factor: make_query(stage, poses, "any", within=factor * bound) for factor in FACTORS}
        found = {factor: query.run() for factor, query in queries.items()}
        work = {factor: float(query.near.node_tests.numpy()[: len(poses)].mean()) for factor, query in queries.items()}
        times = time_launches(context, {factor: query.prove_apart for factor, query in queries.items()})
        plain = make_query(stage, poses, "any")
        plain.run()
        alone = time_launches(context, {"any": plain.launch})["any"]
        for factor in FACTORS:
            near = ~found[factor].apart[: len(subject.poses)]
            error = subject.first_contact(lambda at, d=factor * bound, stage=stage: stage.near(at, d))
            row = {"case": "margin", "subject": subject.name, "value": value, "factor": factor}
            row |= {"margin": factor * bound / subject.size} | judge_answers(near, subject.truth)
            row |= judge_contact(error) | {"us": 1e3 * times[factor] / len(poses), "node_tests": work[factor]}
            yield row | {"cost": times[factor] / alone}


def run(context):
    """Yield the rows of all three dials, subject by subject."""
    for number, subject in enumerate(subjects(context)):
        values = {*PRECISION_FRACTIONS, *context.size(FRACTIONS + MARGIN_FRACTIONS, ())}
        room = max(len(subject.tiled()), subject.stage.room)
        stages = {value: Stage(subject, subject.lods(fraction=value), room) for value in values}
        for step, rows in enumerate((precision_rows, output_rows, margin_rows)):
            context.progress(f"{subject.name}: {rows.__name__.replace('_', ' ')}", 3 * number + step, 24)
            yield from rows(context, subject, stages)
