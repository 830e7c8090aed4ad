"""The study of speed against accuracy: its measures on cases known by hand, and its parts at small sizes. No time is
judged."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import warp_abtree as ab
from bench import tables
from bench.shapes import knot
from bench.studies.motions import Motions, PoseScene, find_first_contact, rotate
from bench.studies.study import Context
from bench.studies.tradeoff import SUMMARIES, competitors, lods, regions, settings, summaries, workload
from warp_abtree.query.contacts import contact_dtypes

pytestmark = pytest.mark.slow


class SmallModels:
    """One knot for every mesh, in a folder that has none of the others."""

    def __init__(self, folder, faces=400):
        self.folder, self.model = folder, ab.Model.from_arrays(*knot(faces), name="knot")

    def has(self, name):
        return name.startswith("knot")

    def load(self, names, base_faces):
        return self.model


@pytest.fixture
def context(device, tmp_path, monkeypatch):
    """A quick context; two tolerances that the knot has LODs for."""
    monkeypatch.setattr(lods, "QUICK_TOLERANCES", (0.2, 0.05))
    return Context(device, True, SmallModels(tmp_path))


def box_workload(device, offset_b=0.0):
    """Two unit cubes, B's corners away from its own origin, that meet face to face along x."""
    box = trimesh.creation.box()
    model = ab.Model.from_arrays(box.vertices, box.faces, base_faces=12, name="box")
    moved = ab.Model.from_arrays(box.vertices + offset_b, box.faces, base_faces=12, name="moved")
    boxes = SimpleNamespace(a=model, b=moved, device=device, size=1.0)
    boxes.motions = Motions(np.random.default_rng(0), 3, model, moved)
    boxes.motions.away[:] = np.eye(3)
    boxes.motions.rotations[:] = 0, 0, 0, 1
    return boxes


def box_scene(boxes, room):
    return PoseScene(boxes.device, (boxes.a, boxes.b), (0, 0), boxes.motions.far, room)


def rows_of(context, part, name):
    """Return the rows of a part; they are finite, and every table of the part has rows."""
    rows = list(part.run(context))
    study = {"study": "tradeoff", "parts": {name: {"rows": rows}}}
    for table in tables.read_layout("studies/tradeoff.toml")["table"]:
        if table["part"] == name:
            found = tables.select_rows(table, study)
            assert found and all(any(column[0] in row for row in found) for column in table["columns"]), table["name"]
    for row in rows:
        for name, value in row.items():
            if isinstance(value, float):
                assert math.isfinite(value), (name, row)
            if name in ("precision", "recall", "share") and value is not None and row["case"] != "precision":
                assert 0 <= value <= 1, (name, row)
    return rows


def by(rows, **where):
    return [row for row in rows if all(row.get(name) == value for name, value in where.items())]


# --- motions and the first contact -----------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_first_contact_of_boxes(device, offset):
    """Cubes of side 1 meet where their centres are 1 apart, wherever B's own origin is."""
    boxes = box_workload(device, offset)
    scene = box_scene(boxes, 8)
    low, high = find_first_contact(scene.intersects, boxes.motions, steps=50)
    assert low == pytest.approx([1, 1, 1], abs=1e-9) and (high >= low).all()
    assert scene.intersects(boxes.motions.poses(low)).all() and not scene.intersects(boxes.motions.poses(high)).any()


def test_first_contact_that_never_comes():
    motions = box_workload("cpu").motions
    low, high = find_first_contact(lambda poses: poses[:, 0] > 0.4, motions, steps=16)
    assert not np.isnan(low[0]) and np.isnan(low[1:]).all() and np.isnan(high[1:]).all()
    found = workload.judge_contact(low - 1)
    assert found["never"] == 2


def test_distances_proved(device):
    """Cubes 0.25 apart: near within 0.3, not within 0.2; what does not fit in the room is asked in parts."""
    boxes = box_workload(device)
    scene = box_scene(boxes, 2)
    poses = boxes.motions.poses([1.25, 1.25, 1.25])
    assert scene.near(poses, 0.3).tolist() == [True] * 3 and scene.near(poses, 0.2).tolist() == [False] * 3
    assert scene.near(poses, [0.3, 0.2, 0.3]).tolist() == [True, False, True]


def test_rotation_by_quaternions():
    half = math.sqrt(0.5)
    turned = rotate(np.array([[0, 0, half, half], [0, 0, 0, 1.0]]), np.array([1.0, 2, 3]))
    assert turned == pytest.approx(np.array([[-2, 1, 3], [1, 2, 3]]))


def test_judged_answers():
    found = workload.judge_answers(np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 1, 0, 1], bool))
    assert (found["missed"], found["invented"]) == (1, 1)
    assert found["precision"] == found["recall"] == pytest.approx(2 / 3)
    assert workload.judge_answers(np.zeros(2, bool), np.zeros(2, bool))["recall"] is None
    error = workload.judge_contact(np.array([0.1, -0.3, np.nan]))
    assert error["contact_mean"] == pytest.approx(0.2) and error["contact_max"] == pytest.approx(0.3)
    assert (error["early_max"], error["late_max"], error["never"]) == (pytest.approx(0.1), pytest.approx(0.3), 1)
    assert workload.judge_contact(np.array([np.nan]))["contact_mean"] is None


def test_front():
    points = [(1, 5), (2, 3), (2, 4), (3, 3), (4, 0), (1, 5)]
    assert workload.find_front(*zip(*points, strict=True)) == [True, True, False, False, True, True]


# --- contact regions -------------------------------------------------------------------------------------------------


def make_contacts(rows):
    """Contacts of (pose, p0, p1)."""
    contacts = np.zeros(len(rows), contact_dtypes()[0])
    for contact, (pose, p0, p1) in zip(contacts, rows, strict=True):
        contact["pair"], contact["p0"], contact["p1"] = pose, p0, p1
    return contacts


def test_regions_of_parallel_lines():
    """Two poses with lines 0.005 and 0.3 apart; a third where one region is missing."""
    truth = make_contacts([(0, (0, 0, 0), (1, 0, 0)), (1, (0, 0, 0), (2, 0, 0)), (2, (0, 0, 0), (1, 0, 0))])
    found = make_contacts([(0, (0, 0.005, 0), (1, 0.005, 0)), (1, (0, 0, 0.3), (2, 0, 0.3))])
    row = regions.compare_regions(regions.make_regions(found, 3, 1.0), regions.make_regions(truth, 3, 1.0))
    assert row["contacts_missed"] == pytest.approx(2 / 3) and row["contacts_invented"] == 0.5
    assert [row["region_mean"], row["region_hausdorff"]] == pytest.approx([0.1525] * 2)
    assert row["region_hausdorff_max"] == pytest.approx(0.3)
    scaled = regions.compare_regions(regions.make_regions(found, 3, 10.0), regions.make_regions(truth, 3, 10.0))
    assert scaled["region_mean"] == pytest.approx(row["region_mean"] / 10), "distances are parts of the size"
    same = regions.compare_regions(regions.make_regions(truth, 3, 1.0), regions.make_regions(truth, 3, 1.0))
    assert same["contacts_missed"] == same["region_hausdorff_max"] == 0


def test_region_that_lacks_half():
    """One region is half of the other: nothing is far from it one way, and the mean the other way is an eighth."""
    whole, half = make_contacts([(0, (0, 0, 0), (1, 0, 0))]), make_contacts([(0, (0, 0, 0), (0.5, 0, 0))])
    for found, truth in ((half, whole), (whole, half)):
        row = regions.compare_regions(regions.make_regions(found, 1, 1.0), regions.make_regions(truth, 1, 1.0))
        assert row["region_mean"] == pytest.approx(0.125, rel=1e-3)
        assert row["region_hausdorff"] == pytest.approx(0.5, rel=1e-2)


def test_distances_equal_brute_force():
    rng = np.random.default_rng(0)
    rows = [(int(rng.integers(3)), *rng.normal(size=(2, 3)) * 0.2 + rng.normal(size=3)) for _ in range(40)]
    rows.append((3, (5, 5, 5), (5, 5, 5)))  # a pose of one sample, whose nearest four are of other poses
    other = regions.make_regions(make_contacts(rows), 5, 1.0)
    points, pose = rng.normal(size=(60, 3)), rng.integers(0, 5, 60)
    expected = regions.segment_distance(points[:, None], other.ends[None])
    expected[pose[:, None] != other.pose] = np.inf
    found = regions.distances(points, pose, other)
    np.testing.assert_allclose(found, expected.min(1), rtol=1e-3)
    assert np.isinf(found[pose == 4]).all() and np.isfinite(found[pose < 4]).all()
    point = np.array([[0.0, 3, 0]])
    assert regions.segment_distance(point, np.array([[[1.0, 0, 0], [1.0, 0, 0]]])) == pytest.approx(math.sqrt(10))


def test_normals():
    pairs = np.zeros((2, 3), contact_dtypes()[1])
    pairs["count"] = [[1, 1, 0], [2, 1, 1]]
    pairs["normal"][0] = (1, 0, 0), (0, 0, 1), (np.nan,) * 3
    pairs["normal"][1] = (0, 1, 0), (0, 0, 1), (0, 0, 1)
    row = regions.compare_normals(*pairs, np.array([False, True, True]))
    assert row["normal_mean"] == pytest.approx(45) and row["normal_clear_mean"] == pytest.approx(0)


def test_resultants():
    """Normals that agree, that cancel, weighted by length, and a pose without contacts."""
    contacts = make_contacts([(0, (0, 0, 0), (1, 0, 0)), (0, (0, 0, 0), (3, 0, 0)), (2, (0, 0, 0), (1, 0, 0))])
    contacts["normal"] = (0, 0, 1), (0, 0, -1), (0, 1, 0)
    assert regions.resultants(contacts, 4).tolist() == [0.5, 0, 1, 0]


# --- parts -----------------------------------------------------------------------------------------------------------


def test_levels_of_detail(context):
    pytest.importorskip("scipy")
    rows = rows_of(context, lods, "lods")
    levels = by(rows, case="level")
    finest = by(levels, kind="fraction", value=1)[0]
    assert finest["missed"] == finest["invented"] == finest["contacts_missed"] == finest["contacts_invented"] == 0
    for name in ("bound", "contact_max", "region_hausdorff_max", "normal_p95"):
        assert finest[name] == 0, name
    assert finest["any_cost"] == 1 and 0 < finest["meet"] < finest["poses"]
    coarse = by(levels, kind="fraction", value=0.1)[0]
    assert coarse["contact_mean"] > 1e-4 and coarse["missed"] + coarse["invented"] > 0 and coarse["region_mean"] > 1e-4
    assert coarse["share"] == pytest.approx(0.1, abs=0.02) and coarse["node_tests"] < finest["node_tests"]
    for row in by(levels, kind="tolerance"):
        assert row["within_tolerance"] and row["coarsest"] and 0 < row["bound"] <= row["value"]
    at = by(rows, case="offset", value=0.1)
    assert sum(row["missed"] for row in at) == coarse["missed"] and len(at) == 10


def test_wrong_lods_are_noticed(context):
    model = context.model("knot")
    assert lods.is_coarsest(model, 0.05)
    other = SimpleNamespace(lod_max=model.lod_max, error_at=model.error_at)
    other.lod_for = lambda tolerance: model.lod_for(tolerance=tolerance) + 1
    assert not lods.is_coarsest(other, 0.05)


def test_settings(context):
    rows = rows_of(context, settings, "settings")
    for row in by(rows, case="precision", setting="exact"):
        assert row["missed"] == row["invented"] == row["faces_missed"] == row["faces_invented"] == 0
    laid = by(rows, case="precision", setting="float32", poses_kind="coincident meshes", value=1)[0]
    assert laid["faces_missed"] > 0 and laid["faces_invented"] > 0
    touching = by(rows, case="precision", setting="exact", poses_kind="at first contact", value=1)[0]
    assert touching["meet"] == touching["poses"] / 2, "one side of each first contact meets, exactly"
    for value in (0.1, 1):
        tests = [by(rows, case="output", setting=name, value=value)[0]["node_tests"] for name in settings.OUTPUTS]
        assert tests[0] < tests[1] == tests[2] == tests[3]
    margins = by(rows, case="margin", value=0.1)
    assert [row["factor"] for row in margins] == list(settings.FACTORS)
    assert margins[0]["recall"] < 1 and all(row["recall"] == 1 and not row["late_max"] for row in margins[3:])
    assert [row["invented"] for row in margins] == sorted(row["invented"] for row in margins)


def test_competitors(context):
    pytest.importorskip("fcl")
    rows = rows_of(context, competitors, "competitors")
    points = by(rows, case="point")
    ours, theirs = (by(points, method=name) for name in (competitors.OURS, competitors.OURS_FCL))
    assert len(ours) == len(theirs) == 4
    for one, other in zip(ours, theirs, strict=True):
        assert (one["missed"], one["invented"]) == (other["missed"], other["invented"])
        assert one["contact_mean"] == pytest.approx(other["contact_mean"], abs=1e-6)
    for row in by(points, method=competitors.HULL):
        assert row["missed"] == 0 and row["late_max"] < 1e-6 and row["contact_mean"] > 1e-3
    for row in by(points, method=competitors.OURS_WITHIN):
        assert row["recall"] == 1 and row["late_max"] == 0
    assert any(row["front"] for row in points) and not all(row["front"] for row in points)
    skipped = any(note.startswith("fast_simplification is skipped") for note in context.notes)
    assert bool(by(points, method=competitors.SIMPLIFIED)) != skipped, "a competitor runs or is named as skipped"


def test_cheapest_level_has_only_finer_ones_within_the_error():
    rows = [{"share": s, "e": e} for s, e in ((1, 0), (0.5, 0.1), (0.2, 0.3), (0.1, 0.2), (0.01, None))]
    assert [summaries.cheapest(rows, "e", limit)["share"] for limit in (0, 0.1, 0.25, 0.3)] == [1, 0.5, 0.5, 0.1]


def test_means_over_workloads():
    rows = [{"workload": name, "value": 1, "poses": 4, "meet": 2, "missed": 1, "invented": 0} for name in "ab"]
    rows[0] |= {"cost": 1.0, "early_max": 0.1, "bound": 1.0}
    rows[1] |= {"cost": 4.0, "early_max": 0.3, "bound": 2.0}
    (row,) = summaries.summarise(rows, "value")
    assert (row["poses"], row["recall"], row["precision"], row["workloads"]) == (8, 0.5, 1.0, 2)
    assert (row["cost"], row["early_max"], row["bound"]) == (pytest.approx(2.0), 0.3, 1.5)
    assert SUMMARIES["outputs"] is summaries.outputs
