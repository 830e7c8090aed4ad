"""The pictures of concepts and guides: the script draws them, and the numbers in those of the repository still hold."""

import importlib.util
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Give a folder with all pictures, and the titles of those that are no text."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("pxr")
    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    figures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figures)
    titles = {}

    def draw(panels, path, title, *_):
        titles[path.name] = [title, *(panel.title for panel in panels)]
        path.touch()

    # Tests of pictures cover what draws; here it is what it is given.
    figures.FOLDER, figures.draw = tmp_path_factory.mktemp("figures"), draw
    figures.main()
    return figures.FOLDER, titles


def test_all_pictures_of_the_pages_are_drawn(drawn):
    pages = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    named = re.findall(r"\(((?:concept|sample)_[\w.]+)\)", pages)
    assert sorted(named) == sorted(path.name for path in drawn[0].iterdir()) and len(named) >= 8
    kept = [path.name for path in DOCS.iterdir() if path.name.startswith(("concept_", "sample_"))]
    assert sorted(named) == sorted(kept)


def test_pictures_say_what_the_library_finds(drawn):
    def words(folder):
        return re.findall(r"<text[^>]*>([^<]*)</text>", (folder / "concept_tree.svg").read_text(encoding="utf-8"))

    assert words(drawn[0]) == words(DOCS) and len(words(DOCS)) > 5
    title, *levels = drawn[1]["concept_traversal.png"]
    pairs = [int(re.search(r": ([\d,]+) of", level)[1].replace(",", "")) for level in levels]
    assert int(re.search(r"to (\d+) intersecting", title)[1]) > 50 and pairs == sorted(pairs)
    _, *lods = drawn[1]["concept_lods.png"]
    assert "the original" in lods[0] and [("error at most" in lod) for lod in lods] == [False, True, True, True]
    free, also, found = map(int, re.findall(r"\d+", drawn[1]["sample_which_pairs.png"][0].split(":")[1]))
    assert free == also == 0 and found > 50
    lods = drawn[1]["sample_which_lod.png"]
    assert len(lods) == 5 and all("face pairs" in lod for lod in lods[1:])
    assert "-0." in drawn[1]["sample_how_far.png"][0], "one ball is inside"
