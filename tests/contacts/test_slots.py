"""Slots of contact witnesses against all near contacts: no contact has a higher score than what its slot keeps."""

import numpy as np
import pytest
import trimesh
from helpers.bodies import about, box, model_of
from helpers.samples import sample
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.contacts.slots import NORMAL_BINS, SCORES, SLOT_ROOM, SLOTS_A_BIN
from warp_abtree.query.stages.slots import SlotStage

GAP = 0.12
BINS, KINDS, ROOM, A_BIN = int(NORMAL_BINS), int(SCORES), int(SLOT_ROOM), int(SLOTS_A_BIN)


def decode(key, width):
    """Return the score and the name in a key of a slot, which has so many bits for the name."""
    key = int(np.uint64(np.int64(key)))
    name = ~key & ((1 << width) - 1)
    bits = ((key >> max(width, 32)) << max(width - 32, 0)) & 0xFFFFFFFF
    bits = bits & 0x7FFFFFFF if bits >> 31 else ~bits & 0xFFFFFFFF
    return float(np.uint32(bits).view(np.float32)), name


def scores_of(points, depth, across, weight):
    """Return the nine scores of each contact, by the definition in `kernels.contacts.slots`."""
    x, y = (weight * points @ direction for direction in across)
    sum, difference = (x + y) / 2**0.5, (x - y) / 2**0.5
    parts = [x, -x, y, -y, sum, -sum, difference, -difference]
    return np.stack([depth, *(depth + part for part in parts)])


BODIES = {
    "cube on a ball": (box(1, 1, 1, splits=2), model_of(trimesh.creation.icosphere(subdivisions=3))),
    "tori": (model_of(trimesh.creation.torus(1.0, 0.4)), model_of(trimesh.creation.torus(0.9, 0.3))),
}


def ask(device, warps, models, pose):
    """Return the query of the points of two objects, the second at a pose, its slots, and all near contacts."""
    scene = scene_with(device, models[0], (models[1], pose))
    with testing.regime(warps=True if warps else None):
        query = ab.ManifoldQuery(scene, [(0, 1)], gap=GAP)
        query.run()
    (stage,) = [stage for stage in query.stages if isinstance(stage, SlotStage)]
    return query, stage.slots, scene.intersect([(0, 1)], output="contacts", gap=GAP).contacts


@pytest.mark.parametrize("warps", [False, True])
@pytest.mark.parametrize("name", BODIES)
def test_no_near_contact_beats_the_winner_of_its_slot(device, name, warps):
    """Faces apart that look towards one another: their nearest points, in float64, of all listed contacts."""
    rng, models, compared, empty, stands = np.random.default_rng(0), BODIES[name], 0, 0, 0
    for _ in range(10):
        way = rng.normal(size=3)
        pose = np.array([*(way / np.linalg.norm(way) * rng.uniform(1.3, 1.6)), *about(rng.normal(size=3), 3.0)])
        query, slots, rows = ask(device, warps, models, pose)
        product = np.einsum("ij,ij->i", rows["normal_a"], rows["normal_b"])
        ahead = np.stack([np.einsum("ij,ij->i", rows["normal"], rows[f"normal_{c}"]) for c in "ab"]) * [[1], [-1]]
        # Where float32 may tell another case.
        clear = (
            (np.abs(ahead - 0.99) > 0.005).all(0) & (np.abs(product + 0.998) > 1e-4) & (np.abs(product + 0.5) > 0.01)
        )
        clear &= (rows["separation"] > 1e-4) & (product < -0.01) & (ahead > 0.017).all(0) & (ahead > 0.99).any(0)
        rows, over_a, over_b = rows[clear], *((ahead > 0.99) & (product > -0.5))[:, clear]
        key, directions = slots.key.numpy()[:ROOM], slots.directions.numpy().reshape(BINS, 3, 3).astype(float)
        weight, widths = slots.weight.numpy()[0], slots.widths.numpy()[0]
        scale = query.pair_poses.numpy()[0]["scale"]
        points = scale * ((rows["p0"] + rows["p1"]) / 2 - models[0].centre)
        mean = rows["normal_a"] - rows["normal_b"]
        normal = np.where(over_a[:, None], rows["normal_a"], np.where(over_b[:, None], -rows["normal_b"], mean))
        stands += (over_a | over_b).sum()
        cosine = normal @ directions[:, 0].T
        sorted_cosine = np.sort(cosine, axis=1)
        clear = sorted_cosine[:, -1] - sorted_cosine[:, -2] > 1e-4  # float32 may tell another bin
        for k in range(BINS):
            own = clear & (cosine.argmax(1) == k)
            kept = [decode(x, int(widths.sum())) for x in key[A_BIN * k + KINDS : A_BIN * k + 2 * KINDS]]
            if not own.any():
                empty += 1
                continue
            best = scores_of(points[own], -scale * rows["separation"][own], directions[k, 1:], float(weight)).max(1)
            scores = np.array([score for score, _ in kept])
            assert (key[A_BIN * k + KINDS : A_BIN * k + 2 * KINDS] != 0).all()
            assert (scores >= best - 2e-6).all()
            compared += 1
    assert compared > 10 and empty > 10 and stands > 10


@pytest.mark.parametrize("warps", [False, True])
def test_winners_are_near_and_have_their_scores(device, warps):
    """Each name is a face pair within the gap, and no score is more than its separation and its reach make it."""
    rng, ball = np.random.default_rng(1), sample("small ball")
    vertices, faces = ball.mesh_at(ball.lod_max)[:2]
    pose = np.array([0.2, 0.3, 2.0, *about(rng.normal(size=3), 2.0)])
    query, slots, rows = ask(device, warps, (ball, ball), pose)
    near = {tuple(pair): separation for pair, separation in zip(rows["faces"].tolist(), rows["separation"])}
    weight, (of_a, of_b) = slots.weight.numpy()[0], slots.widths.numpy()[0]
    scale, seen = query.pair_poses.numpy()[0]["scale"], 0
    corners = (
        scale * (vertices[faces] - ball.centre),
        scale * (vertices[faces] @ quaternion_matrix(pose[3:]).T + pose[:3] - ball.centre),
    )
    for at, key in enumerate(slots.key.numpy()[:ROOM]):
        if key == 0 or at % A_BIN < KINDS or at % A_BIN == 2 * KINDS:
            continue
        score, name = decode(key, int(of_a + of_b))
        pair = name >> int(of_b), name & ((1 << int(of_b)) - 1)
        assert pair in near
        reach = max(np.linalg.norm(own[face], axis=1).max() for own, face in zip(corners, pair))
        assert score <= -scale * near[pair] + weight * (reach + scale * GAP) + 1e-5
        seen += 1
    assert seen > 20
