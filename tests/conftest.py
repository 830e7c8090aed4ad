"""Fixtures of all tests: the devices present, and the folder of real meshes."""

import gc
import os
from pathlib import Path

import pytest
import warp as wp

from warp_abtree import testing
from warp_abtree.state import work_lists

# JAX would take three quarters of a GPU's memory for itself.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
# No test reads or writes the user's models; those of the cache name a folder of their own.
os.environ["WARP_ABTREE_CACHE"] = "off"
wp.config.log_level = wp.LOG_WARNING
wp.init()

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_finish():
    """Keep what was imported, which stays, out of the collections that tests and the interpreter make."""
    gc.freeze()


def slow_rows(*rows):
    """Return cases of several parameters that are marked slow."""
    return [pytest.param(*row, marks=pytest.mark.slow) for row in rows]


def slow(*values):
    """Return cases of a parameter that are marked slow."""
    return slow_rows(*([value] for value in values))


@pytest.fixture(params=[str(device) for device in wp.get_devices()])
def device(request):
    """Name of a Warp device; the test runs once on each one present."""
    return request.param


def real_mesh_path(name):
    """Return the path of NAME.obj.gz, or skip the test.

    The folder is the environment variable ABTREE_MESHES, else ../shared/meshes beside the checkout.
    """
    folder = Path(os.environ.get("ABTREE_MESHES", ROOT.parent / "shared" / "meshes"))
    path = folder / f"{name}.obj.gz"
    if not path.is_file():
        pytest.skip(f"{name}.obj.gz is not at hand; ABTREE_MESHES names the folder of real meshes")
    return path


@pytest.fixture(name="real_mesh_path")
def real_mesh_path_fixture():
    """Give `real_mesh_path` to a test that does not import it."""
    return real_mesh_path


@pytest.fixture(params=["blocks", "lists"])
def update_path(request, monkeypatch):
    """Update tree states both ways: a block each, and all by level lists, also where the whole costs less."""
    monkeypatch.setattr(work_lists, "LISTED_FRACTION", 1.0)
    with testing.regime(block_updates=request.param == "blocks"):
        yield


@pytest.fixture
def half_refitted_in_part():
    """Refit states in part up to half of their faces on every device, also where the whole costs less."""
    with testing.regime(full_refit={"cpu": 0.5, "cuda": 0.5}):
        yield


@pytest.fixture(params=["threads", "warps"])
def regime(request, device):
    """Search as CPUs do, and by warps as GPUs do, a CPU both ways."""
    if request.param == "threads" and device != "cpu":
        pytest.skip("threads are the CPU's")
    with testing.regime(warps=request.param == "warps"):
        yield
