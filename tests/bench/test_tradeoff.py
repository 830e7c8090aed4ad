"""The study of speed against accuracy: its measures on cases known by hand, and its parts at small sizes. No time is
judged."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import warp_abtree as ab
from bench import (
    tradeoff,
    tradeoff_dials,
    tradeoff_figures,
    tradeoff_lods,
    tradeoff_peers,
    tradeoff_promise,
    tradeoff_tables,
)
from bench.shapes import knot
from bench.study import Context
from bench.tradeoff_regions import (
    compare_normals,
    compare_regions,
    distances,
    make_regions,
    resultants,
    segment_distance,
)
from bench.tradeoff_subject import (
    Motions,
    Stage,
    Subject,
    find_first_contact,
    find_front,
    judge_answers,
    judge_contact,
    rotate,
)
from warp_abtree.query.contacts import contact_dtypes

pytestmark = pytest.mark.slow


class SmallModels:
    """One knot for every mesh, in a folder that has none of the others."""

    def __init__(self, folder, faces=400):
        self.folder, self.model = folder, ab.Model.from_arrays(*knot(faces), name="knot")

    def has(self, name):
        return False

    def load(self, names, base_faces, progress):
        return self.model


@pytest.fixture
def context(device, tmp_path, monkeypatch):
    """A quick context; two tolerances that the knot has LODs for."""
    monkeypatch.setattr(tradeoff_lods, "QUICK_TOLERANCES", (0.2, 0.05))
    return Context(device, True, SmallModels(tmp_path), lambda *shown: None)


def box_subject(device, offset_b=0.0):
    """Two unit cubes, B's corners away from its own origin, that meet face to face along x."""
    box = trimesh.creation.box()
    model = ab.Model.from_arrays(box.vertices, box.faces, base_faces=12, name="box")
    moved = ab.Model.from_arrays(box.vertices + offset_b, box.faces, base_faces=12, name="moved")
    subject = SimpleNamespace(a=model, b=moved, device=device, size=1.0)
    subject.motions = Motions(np.random.default_rng(0), 3, model, moved)
    subject.motions.away[:] = np.eye(3)
    subject.motions.turns[:] = 0, 0, 0, 1
    return subject


def rows_of(context, part):
    rows = list(part.run(context))
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
    subject = box_subject(device, offset)
    stage = Stage(subject, (0, 0), 8)
    low, high = find_first_contact(stage.meets, subject.motions, steps=50)
    assert low == pytest.approx([1, 1, 1], abs=1e-9) and (high >= low).all()
    assert stage.meets(subject.motions.poses(low)).all() and not stage.meets(subject.motions.poses(high)).any()


def test_first_contact_that_never_comes():
    motions = box_subject("cpu").motions
    low, high = find_first_contact(lambda poses: poses[:, 0] > 0.4, motions, steps=16)
    assert not np.isnan(low[0]) and np.isnan(low[1:]).all() and np.isnan(high[1:]).all()
    found = judge_contact(low - 1)
    assert found["never"] == 2


def test_distances_proved(device):
    """Cubes 0.25 apart: near within 0.3, not within 0.2; what does not fit in the room is asked in parts."""
    subject = box_subject(device)
    stage = Stage(subject, (0, 0), 2)
    poses = subject.motions.poses([1.25, 1.25, 1.25])
    assert stage.near(poses, 0.3).tolist() == [True] * 3 and stage.near(poses, 0.2).tolist() == [False] * 3
    assert stage.near(poses, [0.3, 0.2, 0.3]).tolist() == [True, False, True]


def test_gap_where_coarse_surfaces_touch_first(device):
    """Cubes that come together along x, y, z, judged 0.1 too early, too late, never: only the first leaves a gap."""
    subject = box_subject(device)
    subject.low, subject.stage = np.ones(3), Stage(subject, (0, 0), 3)
    gaps = tradeoff_lods.find_gaps(subject, np.array([0.1, -0.1, np.nan]))
    assert gaps[0] == pytest.approx(0.1, rel=1e-3) and gaps[1] == 0 and np.isnan(gaps[2])


def test_rotation_by_quaternions():
    half = math.sqrt(0.5)
    turned = rotate(np.array([[0, 0, half, half], [0, 0, 0, 1.0]]), np.array([1.0, 2, 3]))
    assert turned == pytest.approx(np.array([[-2, 1, 3], [1, 2, 3]]))


def test_judged_answers():
    found = judge_answers(np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 1, 0, 1], bool))
    assert (found["missed"], found["invented"]) == (1, 1)
    assert found["precision"] == found["recall"] == pytest.approx(2 / 3)
    assert judge_answers(np.zeros(2, bool), np.zeros(2, bool))["recall"] is None
    error = judge_contact(np.array([0.1, -0.3, np.nan]))
    assert error["contact_mean"] == pytest.approx(0.2) and error["contact_max"] == pytest.approx(0.3)
    assert (error["early_max"], error["late_max"], error["never"]) == (pytest.approx(0.1), pytest.approx(0.3), 1)
    assert judge_contact(np.array([np.nan]))["contact_mean"] is None


def test_front():
    points = [(1, 5), (2, 3), (2, 4), (3, 3), (4, 0), (1, 5)]
    assert find_front(points).tolist() == [True, True, False, False, True, True]


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
    row = compare_regions(make_regions(found, 3, 1.0), make_regions(truth, 3, 1.0))
    assert row["contacts_missed"] == pytest.approx(2 / 3) and row["contacts_invented"] == 0.5
    assert [row["region_mean"], row["region_hausdorff"]] == pytest.approx([0.1525] * 2)
    assert row["region_hausdorff_max"] == pytest.approx(0.3)
    scaled = compare_regions(make_regions(found, 3, 10.0), make_regions(truth, 3, 10.0))
    assert scaled["region_mean"] == pytest.approx(row["region_mean"] / 10), "distances are parts of the size"
    same = compare_regions(make_regions(truth, 3, 1.0), make_regions(truth, 3, 1.0))
    assert same["contacts_missed"] == same["region_hausdorff_max"] == 0


def test_region_that_lacks_half():
    """One region is half of the other: nothing is far from it one way, and the mean the other way is an eighth."""
    whole, half = make_contacts([(0, (0, 0, 0), (1, 0, 0))]), make_contacts([(0, (0, 0, 0), (0.5, 0, 0))])
    for found, truth in ((half, whole), (whole, half)):
        row = compare_regions(make_regions(found, 1, 1.0), make_regions(truth, 1, 1.0))
        assert row["region_mean"] == pytest.approx(0.125, rel=1e-3)
        assert row["region_hausdorff"] == pytest.approx(0.5, rel=1e-2)


def test_distances_equal_brute_force():
    rng = np.random.default_rng(0)
    rows = [(int(rng.integers(3)), *rng.normal(size=(2, 3)) * 0.2 + rng.normal(size=3)) for _ in range(40)]
    rows.append((3, (5, 5, 5), (5, 5, 5)))  # a pose of one sample, whose nearest four are of other poses
    other = make_regions(make_contacts(rows), 5, 1.0)
    points, pose = rng.normal(size=(60, 3)), rng.integers(0, 5, 60)
    expected = segment_distance(points[:, None], other.ends[None])
    expected[pose[:, None] != other.pose] = np.inf
    found = distances(points, pose, other)
    np.testing.assert_allclose(found, expected.min(1), rtol=1e-3)
    assert np.isinf(found[pose == 4]).all() and np.isfinite(found[pose < 4]).all()
    point = np.array([[0.0, 3, 0]])
    assert segment_distance(point, np.array([[[1.0, 0, 0], [1.0, 0, 0]]])) == pytest.approx(math.sqrt(10))


def test_normals():
    pairs = np.zeros((2, 3), contact_dtypes()[1])
    pairs["count"] = [[1, 1, 0], [2, 1, 1]]
    pairs["normal"][0] = (1, 0, 0), (0, 0, 1), (np.nan,) * 3
    pairs["normal"][1] = (0, 1, 0), (0, 0, 1), (0, 0, 1)
    row = compare_normals(*pairs, np.array([False, True, True]))
    assert row["normal_mean"] == pytest.approx(45) and row["normal_clear_mean"] == pytest.approx(0)


def test_resultants():
    """Normals that agree, that cancel, weighted by length, and a pose without contacts."""
    contacts = make_contacts([(0, (0, 0, 0), (1, 0, 0)), (0, (0, 0, 0), (3, 0, 0)), (2, (0, 0, 0), (1, 0, 0))])
    contacts["normal"] = (0, 0, 1), (0, 0, -1), (0, 1, 0)
    assert resultants(contacts, 4).tolist() == [0.5, 0, 1, 0]


# --- parts -----------------------------------------------------------------------------------------------------------


def test_levels_of_detail(context):
    pytest.importorskip("scipy")
    rows = rows_of(context, tradeoff_lods)
    rungs = by(rows, case="rung")
    finest = by(rungs, kind="fraction", value=1)[0]
    assert finest["missed"] == finest["invented"] == finest["contacts_missed"] == finest["contacts_invented"] == 0
    for name in ("bound", "contact_max", "gap_max", "region_hausdorff_max", "normal_p95"):
        assert finest[name] == 0, name
    assert finest["contact_front"] and finest["any_cost"] == 1 and 0 < finest["meet"] < finest["poses"]
    coarse = by(rungs, kind="fraction", value=0.1)[0]
    assert coarse["contact_mean"] > 1e-4 and coarse["missed"] + coarse["invented"] > 0 and coarse["region_mean"] > 1e-4
    assert coarse["share"] == pytest.approx(0.1, abs=0.02) and coarse["node_tests"] < finest["node_tests"]
    for row in rungs:
        assert row["gap_mean"] <= max(0, row["early_max"]) + 1e-12
    for row in by(rungs, kind="tolerance"):
        assert row["within_tolerance"] and row["coarsest"] and 0 < row["bound"] <= row["value"]
    at = by(rows, case="offset", value=0.1)
    assert sum(row["missed"] for row in at) == coarse["missed"] and len(at) == 10
    (part,) = (part for part in tradeoff.PARTS if part.name == "lods")
    check_report(part, rows)


@pytest.mark.parametrize("low, high", [(0.013, 0.0435), (0.05, 0.6), (1.1, 2.3), (0.4, 8.0), (20, 7000)])
def test_ticks_of_costs_are_plain_numbers_that_do_not_overlap(low, high):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7.5), layout="constrained")
    axis = figure.subplots(2, 2)[0, 0]
    axis.plot([low, high], [1, 2])
    tradeoff_figures.cost_axis(axis, "time")
    figure.draw_without_rendering()
    left, right = axis.get_xlim()
    shown = [label for label in axis.get_xticklabels() if left <= label.get_position()[0] <= right]
    assert 2 <= len(shown) <= 7
    assert all(float(label.get_text().replace(",", "")) for label in shown)
    boxes = sorted((label.get_window_extent() for label in shown), key=lambda box: box.x0)
    assert all(one.x1 + 0.5 * one.height < other.x0 for one, other in itertools.pairwise(boxes))


def check_report(part, rows):
    """Every table has rows, every figure draws, every claim is judged."""
    for table in part.tables:
        found = table.rows(rows)
        assert found and all(any(column.name in row for row in found) for column in table.columns), table.name
    for claim in part.claims:
        held, finding = claim.judge(rows)
        assert held in (True, False) and finding
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    for figure in part.figures:
        canvas = Figure(figsize=figure.size, layout="constrained")
        assert figure.draw(rows, canvas) is True
        canvas.canvas.draw()
        assert figure.draw([], Figure()) is False


def test_wrong_lods_are_noticed(context):
    model = context.model("knot")
    assert tradeoff_lods.is_coarsest(model, 0.05)
    other = SimpleNamespace(lod_max=model.lod_max, error_at=model.error_at)
    other.lod_for = lambda tolerance: model.lod_for(tolerance=tolerance) + 1
    assert not tradeoff_lods.is_coarsest(other, 0.05)


def test_dials(context):
    rows = rows_of(context, tradeoff_dials)
    for row in by(rows, case="precision", setting="exact"):
        assert row["missed"] == row["invented"] == row["faces_missed"] == row["faces_invented"] == 0
    laid = by(rows, case="precision", setting="float32", poses_kind="laid on itself", value=1)[0]
    assert laid["faces_missed"] > 0 and laid["faces_invented"] > 0
    touching = by(rows, case="precision", setting="exact", poses_kind="at first contact", value=1)[0]
    assert touching["meet"] == touching["poses"] / 2, "one side of each first contact meets, exactly"
    for value in (0.1, 1):
        tests = [by(rows, case="output", setting=name, value=value)[0]["node_tests"] for name in tradeoff_dials.OUTPUTS]
        assert tests[0] < tests[1] == tests[2] == tests[3]
    margins = by(rows, case="margin", value=0.1)
    assert [row["factor"] for row in margins] == list(tradeoff_dials.FACTORS)
    assert margins[0]["recall"] < 1 and all(row["recall"] == 1 and not row["late_max"] for row in margins[3:])
    assert [row["invented"] for row in margins] == sorted(row["invented"] for row in margins)
    check_report(next(part for part in tradeoff.PARTS if part.name == "dials"), rows)


def test_promises(context):
    pytest.importorskip("igl")
    rows = rows_of(context, tradeoff_promise)
    (surface,), (apart,) = by(rows, case="surface"), by(rows, case="apart")
    assert surface["violations"] == apart["violations"] == 0 and surface["configurations"] >= 60
    assert 0.5 < surface["used_max"] <= 1 + 1e-6 and apart["proved"] > 0.05 and apart["coarse_missed"] > 0.05
    check_report(next(part for part in tradeoff.PARTS if part.name == "promises"), rows)


def test_broken_promises_are_noticed(context):
    """Errors halved, and none at all: points lie beyond the bound, and pairs that meet are proved apart."""
    model = context.model("knot")
    model.progressive.lod_error[:] *= 0.5
    if pytest.importorskip("igl"):
        (row,) = tradeoff_promise.surface_rows(context, {"knot": model})
        assert row["violations"] > 10 and row["used_max"] > 1
    model.progressive.lod_error[:] = 0
    subject = Subject(context, "knot", model, model)
    subject.bound = lambda lods: 1e-3
    assert tradeoff_promise.apart_row(context, subject, np.random.default_rng(0))["violations"] > 0
    assert (
        tradeoff_promise.judge_promise([{"case": "apart", "configurations": 5, "violations": 1}], "apart")[0] is False
    )


def test_rivals(context):
    pytest.importorskip("fcl")
    rows = rows_of(context, tradeoff_peers)
    points = by(rows, case="point")
    ours, theirs = (by(points, method=name) for name in (tradeoff_peers.OURS, tradeoff_peers.OURS_FCL))
    assert len(ours) == len(theirs) == 4
    for one, other in zip(ours, theirs, strict=True):
        assert (one["missed"], one["invented"]) == (other["missed"], other["invented"])
        assert one["contact_mean"] == pytest.approx(other["contact_mean"], abs=1e-6)
    for row in by(points, method=tradeoff_peers.HULL):
        assert row["missed"] == 0 and row["late_max"] < 1e-6 and row["contact_mean"] > 1e-3
    for row in by(points, method=tradeoff_peers.OURS_WITHIN):
        assert row["recall"] == 1 and row["late_max"] == 0
    assert any(row["front"] for row in points) and not all(row["front"] for row in points)
    missing = {"fast_simplification": tradeoff_peers.SIMPLIFIED, "vhacdx": tradeoff_peers.VHACD}
    for module, method in missing.items():
        skipped = any(note.startswith(f"{module} is skipped") for note in context.notes)
        assert bool(by(points, method=method)) != skipped, "a peer runs or is named as skipped"
    check_report(next(part for part in tradeoff.PARTS if part.name == "rivals"), rows)


def test_pieces_are_kept(context, tmp_path):
    """A decomposition made once is read again where its library is not installed."""
    model, made = context.model("knot"), []

    def make(library, vertices, faces, setting):
        made.append(setting)
        return [(vertices[:3], faces[:0]), (vertices[3:6], np.array([[0, 1, 2]]))]

    first = tradeoff_peers.decompose(context, model, "json", make, 3)
    again = tradeoff_peers.decompose(context, model, "json", None, 3)
    assert made == [3] and first[1] == again[1] == 2 and again[0][1].tolist() == [[3, 4, 5]]
    np.testing.assert_allclose(again[0][0], model.mesh_at(model.lod_max)[0][:6])
    assert tradeoff_peers.decompose(context, model, "no_such_module", make, 3) is None
    assert any("no_such_module is skipped" in note for note in context.notes)


def test_cheapest_rung_has_only_finer_ones_within_the_error():
    rows = [{"share": s, "e": e} for s, e in ((1, 0), (0.5, 0.1), (0.2, 0.3), (0.1, 0.2), (0.01, None))]
    assert [tradeoff_tables.cheapest(rows, "e", limit)["share"] for limit in (0, 0.1, 0.25, 0.3)] == [1, 0.5, 0.5, 0.1]
