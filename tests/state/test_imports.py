"""Public names that are imported when first asked for: each alone, no more than it needs, and collections go on."""

import gc
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

import warp_abtree as ab
from warp_abtree.checks.package import find_modules, import_quickly

FRESH = """
import os, sys
import warp
import warp_abtree as ab
for name in sys.argv[1:]:
    child = os.fork()
    if not child:
        try:
            getattr(ab, name)
        except BaseException as error:
            print(f"{name}: {type(error).__name__}: {error}", flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""


def run_fresh(code, *given):
    """Return what a program prints in a process of its own."""
    done = subprocess.run([sys.executable, "-c", code, *given], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_each_name_comes_alone():
    assert run_fresh(FRESH, *ab.__all__) == "" and "Scene" in ab.__all__
    assert run_fresh(FRESH, "Seen") == "Seen: AttributeError: module 'warp_abtree' has no attribute 'Seen'"


def test_a_name_brings_what_it_needs():
    """A model needs no queries; packages of the library are there once they are asked for."""
    code = "import sys, warp_abtree as ab; ab.Model; print(*(name in sys.modules for name in sys.argv[1:]))"
    assert (
        run_fresh(code, "warp_abtree.model.model", "warp_abtree.scene.scene", "warp_abtree.names") == "True False False"
    )
    assert run_fresh("import warp_abtree as ab; print(ab.lod.__name__, len(dir(ab)) > 30)") == "warp_abtree.lod True"
    assert set(find_modules("warp_abtree.names")) == set(ab.__all__) and not find_modules("no_such_module_anywhere")


def test_collections_of_garbage_go_on(tmp_path, monkeypatch):
    """As they were before, also where an import fails."""
    monkeypatch.syspath_prepend(tmp_path)
    Path(tmp_path, "quick_module.py").write_text("import gc\nenabled = gc.isenabled()\n")
    Path(tmp_path, "failing_module.py").write_text("raise KeyError('here')\n")
    assert gc.isenabled() and not import_quickly("quick_module").enabled and gc.isenabled()
    with pytest.raises(KeyError, match="here"):
        import_quickly("failing_module")
    assert gc.isenabled()
    gc.disable()
    try:
        import_quickly("quick_module")
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_collections_go_on_after_several_threads(tmp_path, monkeypatch):
    """One that begins while another one imports, and ends later."""
    monkeypatch.syspath_prepend(tmp_path)
    Path(tmp_path, "slow_module.py").write_text(
        "import test_events\ntest_events.begun.set()\ntest_events.go.wait(30)\n"
    )
    events = SimpleNamespace(begun=threading.Event(), go=threading.Event())
    monkeypatch.setitem(sys.modules, "test_events", events)
    thread = threading.Thread(target=import_quickly, args=["slow_module"])
    thread.start()
    assert events.begun.wait(30) and not gc.isenabled()
    import_quickly("json")
    assert not gc.isenabled()
    events.go.set()
    thread.join()
    assert gc.isenabled()
