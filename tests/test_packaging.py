"""Packaging: wheel and source distribution hold the package, its kernels and scenes, and a wheel runs alone."""

import email
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from helpers import refused

import warp_abtree as ab
from warp_abtree import app, jobs
from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.toml.folder import find_scene, scene_folder, scene_names

ROOT = Path(__file__).resolve().parents[1]
LEAST_SETUPTOOLS = 77  # for the licence as pyproject.toml writes it

not_shipped = pytest.mark.skipif(not (ROOT / "release").is_dir(), reason="release/ is in a checkout alone")


@pytest.fixture(scope="session")
def dist(tmp_path_factory):
    """Give the folder of a built wheel and source distribution: of ABTREE_DIST, or built here."""
    if "ABTREE_DIST" in os.environ:
        return Path(os.environ["ABTREE_DIST"])
    reason = f"needs build and setuptools {LEAST_SETUPTOOLS}, or ABTREE_DIST; .ci/run gives that"
    pytest.importorskip("build", reason=reason)
    pytest.importorskip("setuptools", str(LEAST_SETUPTOOLS), reason=reason)
    folder = tmp_path_factory.mktemp("packaging")
    left_out = shutil.ignore_patterns(".git", ".venv", "dist", "*.egg-info", "__pycache__", ".*_cache")
    shutil.copytree(ROOT, folder / "source", ignore=left_out)
    shutil.rmtree(folder / "source" / "build", ignore_errors=True)  # kernels/build stays
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", folder / "source"]
    subprocess.run(command, check=True, capture_output=True)
    return folder / "dist"


@pytest.fixture(scope="session")
def wheel(dist):
    (path,) = dist.glob("*.whl")
    with zipfile.ZipFile(path) as file:
        yield path, file


def sources(folder, suffixes):
    return {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*") if path.suffix in suffixes}


def test_every_folder_of_modules_is_listed():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.findall(r'"([\w.]+)"', re.search(r"^packages = \[(.*?)\]", text, re.M | re.S)[1])
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "warp_abtree").rglob("*.py")}
    folders |= {Path("warp_abtree") / path.parent.relative_to(ROOT) for path in (ROOT / "kernels").rglob("*.py")}
    scenes = {Path("warp_abtree") / path.parent.relative_to(ROOT) for path in (ROOT / "scenes").rglob("*.py")}
    assert sorted(listed) == sorted(".".join(folder.parts) for folder in folders | scenes)


@pytest.mark.slow
def test_wheel_holds_the_package_and_its_version(wheel):
    path, file = wheel
    held = {name for name in file.namelist() if ".dist-info/" not in name}
    assert {name.split("/")[0] for name in held} == {"warp_abtree"}
    expected = sources("warp_abtree", (".py", ".typed"))
    expected |= {f"warp_abtree/{name}" for name in sources("kernels", (".py", ".h", ".cuh"))}
    expected |= {f"warp_abtree/{name}" for name in sources("scenes", (".py", ".toml"))}
    assert held == expected
    # An installed package has the kernels themselves, not the bridge to a checkout.
    assert file.read("warp_abtree/kernels/__init__.py") == (ROOT / "kernels" / "__init__.py").read_bytes()
    (name,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = email.message_from_bytes(file.read(name))
    assert metadata["Version"] == ab.__version__ == path.name.split("-")[1]
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert ab.__version__ not in text and not re.search(r"^version = \"", text, re.M)
    extras = text.split("[project.optional-dependencies]")[1].split("\n[")[0]
    assert set(metadata.get_all("Provides-Extra")) == set(re.findall(r"^(\w+) = \[", extras, re.M))


@pytest.mark.slow
def test_source_distribution_holds_what_a_wheel_needs(dist):
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as file:
        held = {name.split("/", 1)[1] for name in file.getnames() if "/" in name}
    for folder in ("warp_abtree", "kernels", "scenes", "tests", "bench", "docs"):
        expected = sources(folder, (".py", ".h", ".cuh", ".toml", ".md", ".png", ".svg"))
        assert expected <= held, expected - held
    assert {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "warp_abtree/py.typed"} <= held
    assert not [name for name in held if "__pycache__" in name or name.startswith((".git", "build/", "dist/"))]


@pytest.mark.slow
def test_wheel_runs_without_the_checkout(wheel, tmp_path):
    _, file = wheel
    file.extractall(tmp_path / "installed")
    (tmp_path / "elsewhere").mkdir()

    def python(*words):
        options = {"capture_output": True, "text": True, "timeout": 300, "cwd": tmp_path / "elsewhere"}
        env = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
        return subprocess.run([sys.executable, *words], env=env, **options)

    code = "import runpy\nfrom warp_abtree.app.toml.folder import *\nprint(scene_folder(), *scene_names())\n"
    code += "runpy.run_module('warp_abtree', run_name='__main__')"
    done = python("-c", code, *"run needle --frames 1 --device cpu --json".split())
    folder, found = done.stdout.split("\n", 1)
    assert folder.split() == [str(tmp_path / "installed" / "warp_abtree" / "scenes"), *scene_names()]
    assert done.returncode == 0 and json.loads(found)["frames"] == 1, done.stderr


@pytest.mark.slow
def test_scenes_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scene_folder() == ROOT / "scenes" and "bunny_tori" in scene_names()
    for name in ("bunny_tori", "bunny_tori.toml", Path("bunny_tori")):
        assert find_scene(name) == ROOT / "scenes" / "bunny_tori.toml"
    for name in ("cow", "bunny_tori.npz", "gone/bunny_tori.toml", "warp:bunny", str(tmp_path / "bunny_tori.toml")):
        assert find_scene(name) == Path(name)
    Path("bunny_tori").mkdir()
    assert find_scene("bunny_tori") == ROOT / "scenes" / "bunny_tori.toml"
    Path("bunny_tori.toml").write_text("")
    assert find_scene("bunny_tori.toml") == Path("bunny_tori.toml")
    with pytest.raises(SceneError, match=r"gone\.toml: No such file.*scenes that come.*bunny_tori, "):
        load_scene("gone.toml", device="cpu")
    assert load_scene("needle", device="cpu").path == ROOT / "scenes" / "needle.toml"


@not_shipped
def test_release_notes_are_the_section_of_a_version():
    notes_of = runpy.run_path(str(ROOT / "release" / "release_notes.py"))["notes_of"]
    text = (
        "# Changelog\n\n## Unreleased\n\n## 1.2.0 - 2026-11\n\n### Added\n\n- one\n  line\n- two\n\n## [1.1.0]\n\nold\n"
    )
    assert notes_of("1.2.0", text) == "### Added\n\n- one line\n- two\n"
    assert notes_of("1.1.0", text) == "old\n"
    for version in ("1.2", "Unreleased", "2.0.0"):
        refused(ValueError, rf"nothing about {re.escape(version)}; it has 1\.2\.0, 1\.1\.0", notes_of, version, text)
    changes = notes_of(ab.__version__, (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert "### Added" in changes and "\n## " not in changes


@not_shipped
def test_versions_of_other_files_agree():
    version = ab.__version__
    for name, text in (
        ("CITATION.cff", f"version: {version}\n"),
        ("release/recipe.yaml", f'version: "{version}"'),
        ("README.md", f"warp_abtree-{version}-py3-none-any.whl"),
        ("docs/index.md", f"warp_abtree-{version}-py3-none-any.whl"),
    ):
        assert text in (ROOT / name).read_text(encoding="utf-8"), name
    recipe = (ROOT / "release" / "recipe.yaml").read_text(encoding="utf-8").split("run:\n")[1].split("tests:")[0]
    needed = {line.strip("- ").replace(" ", "") for line in recipe.splitlines() if line.strip().startswith("-")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert needed - {"python>=${{python_min}}"} == set(project["dependencies"])


@pytest.mark.parametrize("module", [ab, jobs, app], ids=lambda module: module.__name__)
def test_api_page_has_every_public_name_once(module):
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    shown = re.findall(rf"^::: {re.escape(module.__name__)}\.(\w+)$", page, re.M)
    assert sorted(shown) == sorted(module.__all__)
