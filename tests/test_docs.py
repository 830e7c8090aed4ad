"""README.md and docs/: Python blocks run, scenes load, commands parse and links resolve. Examples run."""

import contextlib
import importlib.util
import io
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import trimesh.collision
import warp as wp
from helpers import refused

import warp_abtree as ab
from bench import __main__ as bench
from warp_abtree.app import load_scene
from warp_abtree.app.cli import main as cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- needs: ([\w, ]+) -->\n)?^```(\w+)\n(.*?)^```", re.S | re.M)
# What a page does at full size, at one that tests can bear.
SMALLER = {
    "docs/howto_lod.md": (("objects=60", "objects=12"), ("range(120)", "range(66)")),
    "docs/howto_pairs.md": (("100_000", "3_000"),),
}


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def blocks_of(page, language):
    """Return (what a block needs, its text) of every block of a language, smaller where `SMALLER` says so."""
    text = page.read_text(encoding="utf-8")
    for old, new in SMALLER.get(name_of(page), ()):
        assert old in text, f"{name_of(page)} no longer holds {old!r}"
        text = text.replace(old, new)
    return [
        (needs.split(", ") if needs else [], block) for needs, kind, block in BLOCK.findall(text) if kind == language
    ]


def missing(needs):
    """Return what of a block's needs is not here: modules, or "cuda"."""
    here = {"cuda": wp.is_cuda_available()}
    return [need for need in needs if not here.get(need, need != "cuda" and importlib.util.find_spec(need) is not None)]


PYTHON = [(page, i) for page in PAGES for i in range(len(blocks_of(page, "python")))]


@pytest.fixture(scope="module")
def run_block(tmp_path_factory):
    """Return a function that runs a block after those before it on its page, all in one namespace."""
    spaces, done = {}, {}

    def run(page, index):
        space = spaces.setdefault(page, {})
        for i, (needs, block) in enumerate(blocks_of(page, "python")[: index + 1]):
            if i < done.get(page, 0):
                continue
            done[page] = i + 1
            if not missing(needs):
                # Line numbers of the page, for a traceback that can be read.
                start = page.read_text(encoding="utf-8").split("```python\n")[: i + 1]
                lines = sum(part.count("\n") + 1 for part in start)
                exec(compile("\n" * lines + block, name_of(page), "exec"), space)

    folder = tmp_path_factory.mktemp("docs")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield run


@pytest.mark.parametrize(("page", "index"), PYTHON, ids=[f"{name_of(page)}-{i + 1}" for page, i in PYTHON])
@pytest.mark.slow
def test_python_blocks_run(run_block, page, index):
    needs, block = blocks_of(page, "python")[index]
    absent = missing([*needs, *(["pxr"] if "warp:" in block else [])])
    if absent:
        pytest.skip(f"needs {', '.join(absent)}")
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        run_block(page, index)
    assert bool(shown.getvalue()) >= ("print(" in block)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks_of(page, "toml")], ids=name_of)
@pytest.mark.slow
def test_scenes_in_pages_load(page):
    for _, text in blocks_of(page, "toml"):
        loaded = load_scene(page, device="cpu", text=text)
        rows = loaded.frame(output="count").run(2)
        assert rows[-1].objects == loaded.scene.object_count > 1


def test_keys_of_scene_files_are_listed_as_they_are():
    """`python docs/scene_reference.py` writes the page."""
    pytest.importorskip("msgspec")
    made = runpy.run_path(str(ROOT / "docs" / "scene_reference.py"))["make_page"]()
    assert made == (ROOT / "docs" / "scene_keys.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not target.startswith(("http", "#")):
            assert (page.parent / target.split("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_are_named_exist(page):
    """Of the checkout; `warp_abtree/scenes` and kernels stand there in what is installed."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:bench|docs|kernels|scenes|tests|warp_abtree)/[\w./]+)`", text):
        assert (ROOT / name).exists() or name in ("warp_abtree/kernels", "warp_abtree/scenes"), name


def test_bounds_are_numbered_once_and_cited():
    """Every bound of the page on exactness has one number, in turn, and code cites each of them and no other."""
    page = (ROOT / "docs" / "exactness.md").read_text(encoding="utf-8")
    numbered = [int(number) for number in re.findall(r"\(bound (\d+)\)", page)]
    assert numbered == list(range(1, 1 + len(numbered))) and len(numbered) > 20
    cited = set()
    for path in (*(ROOT / "kernels").rglob("*"), *(ROOT / "warp_abtree").rglob("*.py")):
        if path.suffix in (".py", ".h", ".cuh"):
            text = re.sub(r"\s+(?:#|//)?\s*", " ", path.read_text(encoding="utf-8"))
            found = {
                int(n)
                for some in re.findall(r"exactness\.md, bounds? ([\d, and]+)", text)
                for n in re.findall(r"\d+", some)
            }
            assert found <= set(numbered), f"{name_of(path)} cites bounds {sorted(found - set(numbered))}"
            cited |= found
    assert cited == set(numbered)


def test_blocks_are_found_and_told_apart():
    found = BLOCK.findall("x\n<!-- needs: torch, cuda -->\n```python\na\n```\n\n```sh\nb\n```\n```python\nc\n```\n")
    assert found == [("torch, cuda", "python", "a\n"), ("", "sh", "b\n"), ("", "python", "c\n")]
    assert missing(["no_such_module", "numpy"]) == ["no_such_module"]
    assert len(PYTHON) > 15 and [page for page, _ in PYTHON].count(ROOT / "README.md") == 1


def commands_of(page):
    """Yield the words of every `warp-abtree` command in the shell blocks of a page, without its name."""
    for _, text in blocks_of(page, "sh"):
        for line in text.splitlines():
            if "warp-abtree " in line and "--print-completion" not in line:
                yield line.split("warp-abtree ", 1)[1].split("#")[0].split()


@pytest.mark.parametrize("page", [page for page in PAGES if any(commands_of(page))], ids=name_of)
def test_commands_parse(page):
    for words in commands_of(page):
        assert cli.make_parser().parse_args(words).command == words[0]
        for word in words:
            assert not word.startswith("scenes/") or (ROOT / word).is_file()


# Commands that are not run here, and why.
NOT_RUN = {"view": "serves until it is stopped; tests/app/test_view_page.py", "bench": "a study; tests/bench"}


def run_words(words):
    """Run a command of a page at small cost, on the CPU; return why it was not run, or None."""
    if words[0] in NOT_RUN:
        return NOT_RUN[words[0]]
    devices = words[words.index("--device") + 1].split(",") if "--device" in words else ["cpu"]
    if not set(devices) <= {device.alias for device in wp.get_devices()}:
        return f"needs {', '.join(devices)}"
    modules = {"picture": "pyvista", "--plot": "matplotlib", "warp:": "pxr"}
    if "--picture" in words and missing(["pyvista"]):
        at = words.index("--picture")
        words = words[:at] + words[at + 2 :]  # the run itself needs none
    absent = missing([module for part, module in modules.items() if any(part in word for word in words)])
    if absent:
        return f"needs {', '.join(absent)}"
    if "--frames" in words:
        words[words.index("--frames") + 1] = "3"
    elif words[0] == "run":
        words = [*words, "--frames", "2"]
    if words[0] == "sweep" and "--ray" not in words and ("--workers" in words or not missing(["ray"])):
        return "starts a cluster of Ray; tests/jobs/test_ray_pool.py"
    if "--device" not in words:
        words = [*words, "--device", "cpu"]
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        status = cli.main(words)
    assert status == (words[0] == "clash") and shown.getvalue(), words
    return None


def run_page(page, folder):
    """Run a page's commands in a folder, after the Python and the files before them; return why some were not run.

    What installs packages, over the network, is left to .ci/run.
    """
    skipped, space = [], {}
    for needs, kind, block in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "toml" and (name := re.match(r"# (\w+\.toml)\n", block)):
            (folder / name[1]).write_text(block)
        elif (
            kind == "python"
            and re.search(r"\.(save|export)\(", block)
            and not missing(needs.split(", ") if needs else [])
        ):
            exec(block, space)
        elif kind == "sh":
            parts = [part.split("#")[0].split() for line in block.splitlines() for part in line.split("&&")]
            for words in parts:
                if words and words[0].removeprefix(".venv/bin/") == "warp-abtree":
                    skipped.append(run_words(words[1:]))
    return skipped


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=() if page.name == "README.md" else pytest.mark.slow, id=name_of(page))
        for page in PAGES
        if any(commands_of(page))
    ],
)
def test_commands_run_as_they_stand(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    reasons = run_page(page, tmp_path)
    assert reasons
    if None not in reasons:
        pytest.skip("; ".join(dict.fromkeys(reasons)))


@pytest.mark.slow
def test_examples_of_help_run(tmp_path, monkeypatch, capsys):
    """In the order of the commands' own needs, `build` first, in a folder that has poses."""
    pytest.importorskip("pxr")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    for name in ("poses", "ends"):
        np.save(f"{name}.npy", np.eye(7)[[6] * 3])
    run = []
    for name in "build info query run sweep picture".split():
        with pytest.raises(SystemExit):
            cli.main([name, "--help"])
        for line in re.findall(rf"^  warp-abtree ({name} .*)$", capsys.readouterr().out, re.M):
            run.append(run_words(line.split()))
    assert run.count(None) >= 10


def test_hints_name_packages_that_there_are():
    """What a message tells to install is required by an extra under that name."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    known = {re.match(r"[\w-]+", name)[0] for name in re.findall(r'"([\w-]+[^"]*)"', text)}
    hints = {}
    for path in [*(ROOT / "warp_abtree").rglob("*.py"), *(ROOT / "scenes").glob("*.py")]:
        for words in re.findall(r"pip install ([\w\[\]. -]+)", path.read_text(encoding="utf-8")):
            hints.setdefault(words.strip(), path.name)
    assert len(hints) > 5
    wrong = {hint: name for hint, name in hints.items() if not set(hint.split()) <= known | {"torch"}}
    assert not wrong, "the project is on no package index"


def test_benchmarks_exist():
    named = {name for page in PAGES for name in re.findall(r"python -m bench (\w+)", page.read_text(encoding="utf-8"))}
    assert len(named) > 10 and named <= {*bench.CASES, *bench.STUDIES}


SAMPLES = sorted((ROOT / "scenes").glob("[0-9]*.py"))


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_samples_run_and_stand_in_their_pages(path):
    """A sample is short, prints, and is the first block of the page that it names, which shows its picture."""
    text = path.read_text(encoding="utf-8")
    lines, (page,) = text.splitlines(), re.findall(r"docs/\w+\.md", text)
    assert len(lines) <= 40 and f"python scenes/{path.name}" in lines[0]
    assert blocks_of(ROOT / page, "python")[0] == ([], text.split("\n\n", 1)[1])
    picture = f"sample_{path.stem.split('_', 1)[1]}.png"
    assert f"]({picture})" in (ROOT / page).read_text(encoding="utf-8")
    assert (ROOT / "docs" / picture).stat().st_size < 150_000
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        runpy.run_path(str(path))
    assert shown.getvalue()


def test_samples_are_numbered_in_the_order_of_the_site():
    names = [re.search(r"docs/(\w+\.md)", path.read_text(encoding="utf-8"))[1] for path in SAMPLES]
    site = re.findall(r"- (howto_\w+\.md)", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert len(names) >= 5 and [name for name in site if name in names] == names


def test_readme_fits_a_screen_or_two():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 90


def test_readme_has_one_line_for_the_run_and_one_for_the_tests():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for marker, end in (("main-command", "--picture bunny_tori.png"), ("test-command", '-m "not slow"')):
        (block,) = re.findall(rf"<!-- {marker} -->\n```sh\n(.*)\n```", text)
        assert block.startswith("python3 -m venv .venv && .venv/bin/pip install -q -e ") and block.endswith(end)


def run_example(name, *words):
    """Run an example's main with words of a command line; return what it returns, and what it printed."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        found = runpy.run_path(str(ROOT / "scenes" / f"{name}.py"))["main"]([str(word) for word in words])
    return found, shown.getvalue()


def test_planning_example(device, tmp_path):
    hit, shown = run_example("planning", "--device", device, "--poses", 400, "--parts", 6, "--glb", tmp_path / "g.glb")
    assert len(hit) == 400 and 0 < hit.sum() < 400 and "a second" in shown
    written = trimesh.load_scene(tmp_path / "g.glb")
    assert sorted(written.graph.nodes_geometry) == ["bin", "gripper"]
    pytest.importorskip("fcl")
    parts, other = runpy.run_path(str(ROOT / "scenes" / "planning.py")), trimesh.collision.CollisionManager()
    other.add_object("bin", parts["make_bin"](6))
    other.add_object("gripper", parts["make_gripper"]())
    for pose, expected in zip(parts["sample_grasps"](400)[:60], hit):
        matrix = trimesh.transformations.quaternion_matrix(np.roll(pose[3:], 1))
        matrix[:3, 3] = pose[:3]
        other.set_transform("gripper", matrix)
        assert other.in_collision_internal() == expected


def test_worlds_example(device):
    torch = pytest.importorskip("torch")
    words = "--worlds 3 --samples 24 --rounds 6 --device".split()
    (poses, hit), shown = run_example("interop/worlds_torch", *words, device)
    assert "of 3 rings on their pegs" in shown
    assert poses.shape == (3 + 3 * 24, 7) and hit.dtype == torch.bool
    scene, pairs = runpy.run_path(str(ROOT / "scenes" / "interop" / "worlds_torch.py"))["make_scene"](3, 24, device)
    scene.set_poses(poses.cpu().numpy())
    expected = scene.intersect(pairs).any
    assert np.array_equal(hit.cpu().numpy(), expected) and 0 < expected.sum() < len(pairs)


def test_worlds_example_without_torch(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    refused(SystemExit, "skipped: this example needs PyTorch", run_example, "interop/worlds_torch", "--device", "cpu")


@pytest.mark.slow
def test_planner_example(tmp_path):
    for name in ("ompl", "yourdfpy"):
        pytest.importorskip(name)
    arm = runpy.run_path(str(ROOT / "scenes" / "programs" / "arm_in_a_shelf.py"))
    with contextlib.chdir(tmp_path):
        robot = arm["load_arm"]("cpu")
        trimesh.creation.annulus(0.3, 0.5, 0.05).apply_translation((0, 0, 0.7)).export("around.glb")
        way, shown = run_example("interop/ompl_planner", "arm.urdf", "around.glb", "--mounted", "base")
        scene = ab.scene_from_file("around.glb", device="cpu")
    assert f"{len(way)} configurations" in shown and not robot.check(way, scene).any()
    assert robot.check_edges(way[:-1], way[1:], scene)["clear"].all()


@pytest.mark.slow
def test_budget_example(device):
    words = "--objects 12 --frames 70 --part 2 --count-work --device"
    found, shown = run_example("hold_budget", *words.split(), device)
    assert set(found) == {"paper", "predictive"} and "mean error" in shown
    for verdict in found.values():
        assert verdict["frames"] == 10 and verdict["error_mean"] > 0
    assert found["predictive"]["within"] > found["paper"]["within"]


@pytest.mark.slow
def test_several_gpus_example(device):
    words = "--worlds 5 --frames 40 --devices".split()
    counts, shown = run_example("several_gpus", *words, f"{device},{device}")
    assert f"one scene on {device} counts the same" in shown
    assert counts.shape == (5,) and counts.all() and len(set(counts)) > 1
    for devices in (device, ",".join([device] * 7), "cpu"):
        assert np.array_equal(run_example("several_gpus", *words, devices)[0], counts)


def test_several_gpus_example_tells_a_wrong_count(device, monkeypatch):
    monkeypatch.setattr(wp, "capture_launch", lambda graph: None)
    with pytest.raises(SystemExit, match=f"one scene on {device} counts otherwise"):
        run_example("several_gpus", "--devices", device, "--worlds", 3)
