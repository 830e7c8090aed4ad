"""Programs of scenes/programs, and pictures of the pages: each is made, small, and shows what is true."""

import importlib.util
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from warp_abtree import app

PROGRAMS = Path(__file__).resolve().parents[1] / "scenes" / "programs"
DOCS = PROGRAMS.parents[1] / "docs"


@pytest.fixture
def run(tmp_path, monkeypatch, device):
    """Give a function that runs a program in an empty folder and returns what its `main` does."""
    monkeypatch.chdir(tmp_path)
    if not importlib.util.find_spec("pyvista"):
        monkeypatch.setattr(app, "picture", lambda scene, path, **_: Path(path).write_bytes(bytes(9000)))

    def run(name, *arguments, **options):
        found = runpy.run_path(str(PROGRAMS / f"{name}.py"))["main"](*arguments, device=device, **options)
        assert Path(f"{name}.png").stat().st_size > 5_000
        return found

    return run


def test_each_program_is_short_and_shown():
    page = (DOCS / "programs.md").read_text(encoding="utf-8")
    for path in PROGRAMS.glob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 60 and f"python scenes/programs/{path.name}" in text
        assert f"({path.name})" not in page and f"scenes/programs/{path.name})" in page
        assert (DOCS / f"program_{path.stem}.png").stat().st_size < 150_000 and f"program_{path.stem}.png" in page


def test_grasps(run):
    """A pose is free and its fingers close on a wall or the handle, never by more than they open."""
    _, free, width = run("grasps", 400)
    assert 0 < free.sum() < 200 and np.isnan(width[~free]).all()
    assert ((width[free] > 0.004) & (width[free] < 0.1)).all()


def test_an_arm_in_a_shelf(run):
    pytest.importorskip("yourdfpy")
    free, edges = run("arm_in_a_shelf", 1500)
    assert 0.5 < len(free) / 1500 < 1 and 0 < edges["clear"].sum() < len(edges)


def test_a_clash_report(run):
    """Of sleeves and rails that overlap by 0.75 mm, the way out is as long; some bolts are off by too much."""
    scene, clashes, way = run("clash_report")
    assert scene.object_count == 50 and len(scene.models) == 4
    names = [{row["first"].split()[0], row["second"].split()[0]} for row in clashes]
    assert names.count({"sleeve", "rail"}) == 4 and names.count({"sleeve", "bolt"}) >= 1
    rails = [depth for depth, (i, j) in zip(way.depth, way.pairs) if "rail" in scene.name(i) + scene.name(j)]
    np.testing.assert_allclose(rails, 0.75, atol=1e-4)
    assert len(Path("clashes.csv").read_text().splitlines()) > 50


def test_a_loop_of_ones_own(run):
    rows, swarm = run("own_loop", 30, frames=12)
    assert len(rows) == 9 and all(row.objects == 30 for row in rows) and len(swarm) == 30


@pytest.mark.slow
def test_worlds_of_newton(run):
    pytest.importorskip("newton")
    rings, around = run("newton_worlds", 4, 0.5)
    assert rings.shape == (4, 7) and (rings[:, 2] < 1.6).all() and (rings[:, 2] > 0.2).all() and len(around) == 4


@pytest.mark.slow
def test_pictures_of_the_pages_say_what_the_library_finds(tmp_path):
    """All that pages name, and no others; what draws is tested elsewhere, here it is what it is given."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("pxr")
    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    figures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figures)
    titles = {}

    def draw(panels, path, title, *_):
        titles[path.name] = [title, *(panel.title for panel in panels)]
        path.touch()

    def words(folder):
        return re.findall(r"<text[^>]*>([^<]*)</text>", (folder / "concept_tree.svg").read_text(encoding="utf-8"))

    figures.FOLDER, figures.draw = tmp_path, draw
    figures.main()
    pages = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    named = re.findall(r"\(((?:concept|sample)_[\w.]+)\)", pages)
    assert sorted(named) == sorted(path.name for path in tmp_path.iterdir()) and len(named) >= 8
    kept = [path.name for path in DOCS.iterdir() if path.name.startswith(("concept_", "sample_"))]
    assert sorted(named) == sorted(kept)
    assert words(tmp_path) == words(DOCS) and len(words(DOCS)) > 5
    title, *levels = titles["concept_traversal.png"]
    pairs = [int(re.search(r": ([\d,]+) of", level)[1].replace(",", "")) for level in levels]
    assert int(re.search(r"to (\d+) intersecting", title)[1]) > 50 and pairs == sorted(pairs)
    _, *lods = titles["concept_lods.png"]
    assert "the original" in lods[0] and [("error at most" in lod) for lod in lods] == [False, True, True, True]
    free, also, found = map(int, re.findall(r"\d+", titles["sample_which_pairs.png"][0].split(":")[1]))
    assert free == also == 0 and found > 50
    lods = titles["sample_which_lod.png"]
    assert len(lods) == 5 and all("face pairs" in lod for lod in lods[1:])
    assert "-0." in titles["sample_how_far.png"][0], "one ball is inside"
