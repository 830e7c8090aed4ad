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
from conftest import slow
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


def blocks_of(page):
    """Yield (what a block needs, its language, its text, its first line) of a page, smaller where `SMALLER` says so."""
    text = page.read_text(encoding="utf-8")
    for old, new in SMALLER.get(name_of(page), ()):
        assert old in text, f"{name_of(page)} no longer holds {old!r}"
        text = text.replace(old, new)
    for match in BLOCK.finditer(text):
        yield match[1].split(", ") if match[1] else [], match[2], match[3], text[: match.start(3)].count("\n")


def missing(needs):
    """Return what of a block's needs is not here: modules, or "cuda"."""
    here = {"cuda": wp.is_cuda_available()}
    return [need for need in needs if not here.get(need, need != "cuda" and importlib.util.find_spec(need) is not None)]


def test_keys_of_scene_files_are_listed_as_they_are():
    """`python docs/scene_reference.py` writes the page."""
    pytest.importorskip("msgspec")
    made = runpy.run_path(str(ROOT / "docs" / "scene_reference.py"))["make_page"]()
    assert made == (ROOT / "docs" / "scene_keys.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_names_lead_somewhere(page):
    """`warp_abtree/scenes` and kernels stand there in what is installed."""
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.S)):
        if not target.startswith(("http", "#")):
            assert (page.parent / target.split("#")[0]).exists(), target
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


# Commands that are not run here, and why.
NOT_RUN = {"view": "serves until it is stopped; tests/app/test_view_page.py", "bench": "a study; tests/bench"}


def run_words(words):
    """Run a command of a page at small cost, on the CPU; return why it was not run, or None."""
    if "--print-completion" in words:
        return "a script of a shell"
    assert cli.make_parser().parse_args(words).command == words[0]
    assert all((ROOT / word).is_file() for word in words if word.startswith("scenes/"))
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
    if "rain" in words:
        words = [*words, "--objects", "40"]  # the last one given counts
    if "--frames" in words:
        words[words.index("--frames") + 1] = "3"
    elif words[0] == "run":
        words = [*words, "--frames", "2"]
    if words[0] == "sweep" and "--ray" not in words and ("--workers" in words or not missing(["ray"])):
        return "starts a cluster of Ray; tests/jobs/test_sweep_job.py"
    if "--device" not in words:
        words = [*words, "--device", "cpu"]
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        status = cli.main(words)
    assert status == (words[0] == "clash") and shown.getvalue(), words
    return None


def run_python(page, needs, block, line, space):
    """Run a block in the namespace of those before it on its page, where what it needs is here."""
    shown = io.StringIO()
    if not missing([*needs, *(["pxr"] if "warp:" in block else [])]):
        with contextlib.redirect_stdout(shown):
            exec(compile("\n" * line + block, name_of(page), "exec"), space)
        assert bool(shown.getvalue()) >= ("print(" in block)


RUN = [page for page in PAGES if {kind for _, kind, *_ in blocks_of(page)} & {"python", "toml", "sh"}]
assert len(RUN) > 15 and RUN[0].name == "README.md", "blocks are found"


@pytest.mark.parametrize("page", [RUN[0], *slow(*RUN[1:])], ids=name_of)
def test_pages_run_as_they_stand(page, tmp_path, monkeypatch):
    """Python, scene files and commands, in their order in a folder; what installs packages is left to .ci/run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    space = {}
    for needs, kind, block, line in blocks_of(page):
        if kind == "python":
            run_python(page, needs, block, line, space)
        elif kind == "toml":
            if name := re.match(r"# (\w+\.toml)\n", block):
                (tmp_path / name[1]).write_text(block)
            loaded = load_scene(page, device="cpu", text=block)
            assert loaded.frame(output="count").run(2)[-1].objects == loaded.scene.object_count > 1
        elif kind == "sh":
            for words in [part.split("#")[0].split() for text in block.splitlines() for part in text.split("&&")]:
                if words and words[0].removeprefix(".venv/bin/") == "warp-abtree":
                    run_words(words[1:])


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


SAMPLES = sorted((ROOT / "scenes").glob("[0-9]*.py"))


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_samples_run_and_stand_in_their_pages(path):
    """A sample is short, prints, and is the first block of the page that it names, which shows its picture."""
    text = path.read_text(encoding="utf-8")
    lines, (page,) = text.splitlines(), re.findall(r"docs/\w+\.md", text)
    assert len(lines) <= 40 and f"python scenes/{path.name}" in lines[0]
    assert next(block for _, kind, block, _ in blocks_of(ROOT / page) if kind == "python") == text.split("\n\n", 1)[1]
    picture = f"sample_{path.stem.split('_', 1)[1]}.png"
    assert f"]({picture})" in (ROOT / page).read_text(encoding="utf-8")
    assert (ROOT / "docs" / picture).stat().st_size < 150_000
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        runpy.run_path(str(path))
    assert shown.getvalue()


def test_samples_are_numbered_as_in_the_site_and_benchmarks_exist():
    names = [re.search(r"docs/(\w+\.md)", path.read_text(encoding="utf-8"))[1] for path in SAMPLES]
    site = re.findall(r"- (howto_\w+\.md)", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert len(names) >= 5 and [name for name in site if name in names] == names
    named = {name for page in PAGES for name in re.findall(r"python -m bench (\w+)", page.read_text(encoding="utf-8"))}
    assert len(named) > 10 and named <= {*bench.CASES, *bench.STUDIES}


def test_readme_fits_a_screen_or_two_and_has_a_line_for_the_run_and_one_for_the_tests():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 90
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


def test_worlds_example(device, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "torch", None)
        refused(SystemExit, "skipped: this example needs PyTorch", run_example, "interop/worlds_torch")
    torch = pytest.importorskip("torch")
    words = "--worlds 3 --samples 24 --rounds 6 --device".split()
    (poses, hit), shown = run_example("interop/worlds_torch", *words, device)
    assert "of 3 rings on their pegs" in shown
    assert poses.shape == (3 + 3 * 24, 7) and hit.dtype == torch.bool
    scene, pairs = runpy.run_path(str(ROOT / "scenes" / "interop" / "worlds_torch.py"))["make_scene"](3, 24, device)
    scene.set_poses(poses.cpu().numpy())
    expected = scene.intersect(pairs).any
    assert np.array_equal(hit.cpu().numpy(), expected) and 0 < expected.sum() < len(pairs)


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
def test_several_gpus_example(device, monkeypatch):
    words = "--worlds 5 --frames 40 --devices".split()
    counts, shown = run_example("several_gpus", *words, f"{device},{device}")
    assert f"one scene on {device} counts the same" in shown
    assert counts.shape == (5,) and counts.all() and len(set(counts)) > 1
    for devices in (device, ",".join([device] * 7), "cpu"):
        assert np.array_equal(run_example("several_gpus", *words, devices)[0], counts)
    monkeypatch.setattr(wp, "capture_launch", lambda graph: None)
    with pytest.raises(SystemExit, match=f"one scene on {device} counts otherwise"):
        run_example("several_gpus", "--devices", device, "--worlds", 3)
