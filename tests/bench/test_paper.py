"""The experiments of the paper: their counts and measures against plain Python, on meshes small enough for it."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_abtree as ab
from bench import paper_lods, paper_meshes, paper_query, paper_setup, paper_tree, paper_update
from bench.shapes import knot
from bench.study import Context

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model():
    return ab.Model.from_arrays(*knot(300), name="knot")


class KnotFolder:
    """Gives the same small model for every mesh."""

    def __init__(self, model):
        self.model = model

    def load(self, names, base_faces, progress):
        return self.model


@pytest.fixture
def context(model, device):
    return Context(device, True, KnotFolder(model), lambda *_: None)


def test_ancestors_are_counted_once():
    rng = np.random.default_rng(0)
    for _ in range(20):
        leaves = rng.integers(1, 64, rng.integers(1, 12))
        above = {int(leaf) >> i for leaf in leaves for i in range(7)} - {0}
        assert paper_update.count_ancestors(leaves) == len(above)


def test_figure_6_counts_what_the_update_marks(context, model):
    rows = list(paper_update.run_figure_6(context))
    moves = [row for row in rows if row["case"] == "move" and row["model"] == "knot"]
    assert {row["k"] for row in moves if row["splits"] == model.lod_max} == {model.face_count}
    assert all(row["nodes"] <= row["bound"] and row["refit_ms"] > 0 for row in moves)
    starts, slices = model.progressive.split_start, model.progressive.split_face
    for row in moves:
        if row["from_finest"]:
            faces = np.unique(slices[starts[model.lod_max - row["splits"]] :])
            assert row["k"] == len(faces)
            assert row["nodes"] == paper_update.count_ancestors(model.tree.leaf_node[faces])
    held, finding = paper_update.judge_bound(rows)
    assert held and "of equation (1)" in finding


def test_fit_of_figure_6():
    """Times that are 3 ns a node of equation (1) give that back, and the crossover with a flat full refit."""
    shares = np.geomspace(0.001, 1, 40)
    rows = []
    for share in shares:
        k = share * 1000
        bound = paper_update.bound_nodes(k, 1000)
        row = {"case": "move", "model": "m", "faces": 1000, "k": k, "share": share, "nodes": bound / 2}
        rows.append(row | {"bound": bound, "refit_ms": 3e-6 * bound, "full_ms": 3e-6 * 1200})
    (fit,) = paper_update.fit_figure_6(rows)
    assert fit["ns_a_node"] == pytest.approx(3.0) and fit["correlation"] == pytest.approx(1.0)
    assert paper_update.bound_nodes(1000 * fit["crossover"], 1000) == pytest.approx(1200, rel=0.02)
    assert paper_update.find_crossover([0.1, 1.0], [-1.0, -0.5]) is None
    assert paper_update.find_crossover([0.1, 1.0], [1.0, 2.0]) == 0.0


def test_a_tenth_of_the_faces(model):
    lod = paper_update.find_tenth(model)
    starts, slices = model.progressive.split_start, model.progressive.split_face
    assert len(np.unique(slices[starts[lod] :])) < 0.1 * model.face_count
    assert len(np.unique(slices[starts[lod - 1] :])) >= 0.1 * model.face_count


def test_share_of_the_query(context, model):
    rows = list(paper_update.time_shares(context, model, paper_update.find_tenth(model), 3, 1))
    assert [row["configuration"] for row in rows] == ["touching", "light", "deep"]
    assert all(row["k"] < 0.1 * model.face_count and row["states"] == 1 for row in rows)
    assert rows[0]["hits"] <= rows[1]["hits"] <= rows[2]["hits"]


def test_posed_pairs_touch_at_the_depth_asked(model, device):
    posed = paper_setup.PosedPairs(model, 4, device, firsts=4, steps=12)
    for depth, meets in ((-0.01, 0), (-1e-9, 0), (1e-9, 4)):
        posed.push(depth)
        assert posed.scene.intersect(posed.pairs).any.sum() == meets


def test_static_trees_answer_the_same(context, model, monkeypatch):
    rows = list(paper_query.run_static(context))
    assert {row["share"] for row in rows} >= {1.0}
    assert all(row["ours_nodes"] == row["static_nodes"] for row in rows if row["share"] == 1.0)
    # A static tree over other vertices must be caught.
    whole = ab.Model.mesh_at
    moved = lambda self, lod: (whole(self, lod)[0] * 1.1, *whole(self, lod)[1:])  # noqa: E731
    monkeypatch.setattr(ab.Model, "mesh_at", moved)
    with pytest.raises(RuntimeError, match="other face pairs"):
        list(paper_query.run_static(context))


@pytest.mark.parametrize("kind", paper_tree.KINDS)
def test_linked_trees(model, kind):
    vertices, faces, _ = model.mesh_at(model.lod_max)
    tree = paper_tree.build_tree(vertices, faces, kind)
    assert len(tree.parent) == 2 * len(faces) - 1 and (tree.parent[1:] < np.arange(1, len(tree.parent))).all()
    assert len(set(tree.leaf.tolist())) == len(faces)
    chosen = [5, 17, 18]
    above = set()
    for face in chosen:
        node = tree.leaf[face]
        while node >= 0:
            above.add(int(node))
            node = tree.parent[node]
    assert paper_tree.mark(tree, chosen) == len(above)
    coarse = model.mesh_at(model.lod_for(fraction=0.2))
    left, right, lower, upper, face = paper_tree.pack(tree, *coarse)
    inside = left >= 0
    assert len(left) == 2 * len(coarse[1]) - 1 and sorted(face[~inside]) == list(range(len(coarse[1])))
    assert (face[inside] == -1).all() and sorted([*left[inside], *right[inside]]) == list(range(1, len(left)))
    for bound, worst, pick in ((lower, np.minimum, np.min), (upper, np.maximum, np.max)):
        assert np.array_equal(bound[inside], worst(bound[left[inside]], bound[right[inside]]))
        assert np.array_equal(bound[~inside], pick(coarse[0][coarse[1]], 1)[face[~inside]])


def test_a_split_at_the_middle_is_at_the_middle():
    x = np.array([0.0, 1, 2, 3, 100])[:, None, None]
    vertices = (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) * 0.5 + x * [1.0, 0, 0]).reshape(-1, 3)
    faces = np.arange(15).reshape(-1, 3)
    tree = paper_tree.build_tree(vertices, faces, "middle")
    assert tree.depth[tree.leaf].tolist() == [3, 3, 3, 3, 1]
    assert sorted(paper_tree.build_tree(vertices, faces, "median").depth[tree.leaf])[-1] <= 3


def test_walk_finds_the_faces_whose_boxes_overlap(model, device):
    vertices, faces, _ = mesh = model.mesh_at(model.lod_for(fraction=0.3))
    original = model.mesh_at(model.lod_max)
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[1, :3, 3] = 0.21, 0.04, -0.1
    lower, upper = vertices[faces].min(1), vertices[faces].max(1)
    truth = []
    for matrix in matrices:
        low, high = lower + matrix[:3, 3], upper + matrix[:3, 3]
        truth.append(int(((lower[:, None] <= high).all(2) & (low <= upper[:, None]).all(2)).sum()))
    for kind in paper_tree.KINDS:
        tree = paper_tree.build_tree(*original[:2], kind)
        walk = paper_tree.Walk(paper_tree.pack(tree, *mesh), matrices, wp.get_device(device))
        walk.launch()
        # Boxes are widened by a part in a million, which may add a pair that just misses.
        assert np.abs(walk.faces.numpy() - truth).max() <= 2 and (walk.faces.numpy() >= truth).all()


def test_surface_error(device):
    """A sphere beside a greater one: every distance is the difference of the radii, give or take a facet's sag."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    mean, there, worst = paper_meshes.surface_error((vertices, faces), (1.1 * vertices, faces), 5000, device)
    assert mean == pytest.approx(0.1, abs=2e-3) and there == pytest.approx(0.1, abs=2e-3)
    assert worst == pytest.approx(0.1, abs=2e-3)
    # A mesh that lacks a half: the original is far from it, not the other way.
    half = faces[vertices[faces][:, :, 0].mean(1) > 0]
    _, there, worst = paper_meshes.surface_error((vertices, faces), (vertices, half), 5000, device)
    _, back, _ = paper_meshes.surface_error((vertices, half), (vertices, faces), 5000, device)
    assert there == worst > 1 and back < 1e-6


@pytest.mark.parametrize("module", ["vtk", "fast_simplification"])
def test_peers_simplify(module):
    library = pytest.importorskip(module)
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = paper_meshes.SIMPLIFIERS[module](library, ball.vertices, ball.faces, 200)
    assert 150 < len(faces) <= 202 and np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.1


def test_figure_4(context):
    rows = list(paper_lods.step_figure_4(context))
    held, finding = paper_lods.judge_figure_4(rows)
    assert held and finding.startswith("27 of 30")
    rows[4]["moved"] += 1
    assert not paper_lods.judge_figure_4(rows)[0]


def test_cache_is_counted(context, model):
    lods = [0, model.lod_max]
    meshes = [model.mesh_at(lod) for lod in lods]
    bytes_ = sum(24 * len(v) + 12 * len(f) + 32 * (2 * len(f) - 1) for v, f, _ in meshes)
    assert paper_lods.cache_bytes(model, lods) == bytes_
    row = paper_lods.time_changes(context, model, ab.Ladder([model], 9, "ratio").lod[0])
    assert row["changes"] == 3 and 0 < row["k_share"] <= 1 and row["bvh_ms"] > 0
