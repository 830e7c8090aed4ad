"""Kernels that several threads compile: each once, all before they are launched, and errors come through."""

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import trimesh
import warp as wp
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree.checks import kernel_loading
from warp_abtree.scene.kept_queries import yes_or_no_kernels
from warp_abtree.testing import regime


def make_kernel(snippet):
    """Return a kernel of a module of its own."""

    @wp.func_native(snippet)
    def write(x: wp.array(dtype=wp.int32)): ...

    @wp.kernel(module="unique", module_options={"enable_backward": False, "block_dim": 32})
    def write_kernel(x: wp.array(dtype=wp.int32)):
        write(x)

    return write_kernel


def make_kernels(number, code="x.data[0] = {};", count=4):
    """Return kernels that are new to this process, and their block sizes."""
    return [(make_kernel(code.format(100 * number + i)), 32) for i in range(count)]


def loads_of(monkeypatch, cores):
    """Return the list of modules that are loaded from now on."""
    found, force_load = [], wp.force_load
    monkeypatch.setattr(kernel_loading, "core_count", lambda: cores)
    monkeypatch.setattr(wp, "force_load", lambda device, *given: (found.extend(given[0]), force_load(device, *given)))
    return found


def test_each_kernel_is_loaded_once_beside_other_work(device, monkeypatch):
    """It is told of by the thread that asked, as kernels come; of what is loaded already nothing."""
    loaded, device, kernels, told = loads_of(monkeypatch, 4), wp.get_device(device), make_kernels(1), []
    monkeypatch.setattr(kernel_loading, "_told", [])
    kernel_loading.tell_loading(lambda *counts: told.append((*counts, threading.get_ident())))
    for _ in range(2):
        with kernel_loading.loading(device, [*kernels, kernels[0]]):
            pass
        assert sorted(map(id, loaded)) == sorted(id(kernel.module) for kernel, _ in kernels)
    counts = [done for done, total, thread in told if (total, thread) == (4, threading.get_ident())]
    assert len(counts) == len(told) > 1 and counts == sorted(counts) and (counts[0], counts[-1]) == (0, 4)
    out = wp.zeros(1, dtype=wp.int32, device=device)
    for i, (kernel, block_dim) in enumerate(kernels):
        wp.launch(kernel, 1, [out], device=device, block_dim=block_dim)
        assert out.numpy()[0] == 100 + i
    # One core waits for the launches.
    loaded = loads_of(monkeypatch, 1)
    with kernel_loading.loading(wp.get_device(device), make_kernels(2)):
        pass
    assert not loaded


def test_an_error_ends_it_and_is_said_again(device, monkeypatch):
    """Of the work beside first, then of the compiler."""
    told, device, kernels = threading.Event(), wp.get_device(device), make_kernels(3, count=1)

    def fail(*_):
        told.set()
        raise RuntimeError("build failed")

    monkeypatch.setattr(kernel_loading, "core_count", lambda: 2)
    monkeypatch.setattr(wp, "force_load", fail)
    with pytest.raises(KeyError, match="beside"), kernel_loading.loading(device, kernels):
        raise KeyError("beside")
    for _ in range(2):
        told.clear()
        with pytest.raises(RuntimeError, match="build failed"), kernel_loading.loading(device, kernels):
            assert told.wait(60), "the other thread is told"


def compile_ahead(monkeypatch, device, cores, kernels, number):
    """Return how many of some kernels that a query would launch are compiled while a model seems to be built."""
    found, force_load, compile_module = [], wp.force_load, wp.compile_aot_module
    monkeypatch.setattr(kernel_loading, "core_count", lambda: cores)
    monkeypatch.setattr(kernel_loading, "_first_query", [lambda device, face_counts: kernels])
    monkeypatch.setattr(wp, "force_load", lambda *given: found.append(force_load(*given)))
    monkeypatch.setattr(wp, "compile_aot_module", lambda *given: found.append(compile_module(*given)))
    end = time.monotonic() + 60
    with wp.ScopedDevice(device), kernel_loading.compiling_ahead(1, []):
        while len(found) < number and time.monotonic() < end:
            time.sleep(0.01)
    monkeypatch.undo()
    return len(found)


def test_kernels_of_a_query_are_compiled_beside_a_build(device, monkeypatch):
    """As a launch finds them, where there are cores."""
    kernels = make_kernels(time.time_ns() % 10**7, count=2)
    assert compile_ahead(monkeypatch, device, 1, kernels, 0) == 0
    assert compile_ahead(monkeypatch, device, 4, kernels, len(kernels)) == len(kernels)
    for kernel, block_dim in kernels:
        folder = kernel.module.get_module_identifier(1 if wp.get_device(device).is_cpu else block_dim)
        assert [file.suffix for file in Path(wp.config.kernel_cache_dir, folder).iterdir() if file.suffix == ".meta"]


def test_the_end_of_a_build_waits_for_what_has_begun_and_compiles_meanwhile(monkeypatch):
    """One thread is held at its first kernel; it takes no other, and the calling one goes on until that is done."""
    held, compiled_two, taken = threading.Event(), threading.Event(), {True: 0, False: 0}

    def load(*_):
        calling = threading.current_thread() is threading.main_thread()
        taken[calling] += 1
        if calling and taken[calling] == 2:
            compiled_two.set()
        elif not calling:
            held.set()
            assert compiled_two.wait(60)

    kernels = make_kernels(4)
    monkeypatch.setattr(kernel_loading, "core_count", lambda: 2)
    monkeypatch.setattr(kernel_loading, "_first_query", [lambda device, face_counts: kernels])
    monkeypatch.setattr(wp, "force_load", load)
    with wp.ScopedDevice("cpu"), kernel_loading.compiling_ahead(1, []):
        assert held.wait(60)
    assert taken[False] == 1 and 2 <= taken[True] <= 3


def test_an_error_ahead_is_said_by_the_launch(device, monkeypatch):
    kernels = make_kernels(4, "no code {};", 1)
    compile_ahead(monkeypatch, device, 4, kernels, 0)
    monkeypatch.setattr(kernel_loading, "core_count", lambda: 2)
    with pytest.raises(Exception, match="build failed"), kernel_loading.loading(wp.get_device(device), kernels):
        pass


# Modules of the first answer about two small models: on threads of the CPU, and on warps.
MODULES = {"any": (6, 11), "faces": (6, 12), "contacts": (9, 14), "distance": (6, 14)}


@pytest.mark.parametrize("output", MODULES)
@pytest.mark.parametrize("warps", [False, True])
def test_all_that_a_first_query_launches_is_loaded_before(device, monkeypatch, output, warps):
    """Nothing else is compiled, and no launch waits for the compiler; but for records of contacts, which are small."""
    if not warps and wp.get_device(device).is_cuda:
        pytest.skip("threads take pairs on the CPU alone")
    ball = ab.Model.load(trimesh.creation.icosphere(subdivisions=1))
    loaded, launched, launch = loads_of(monkeypatch, 4), [], wp.launch
    monkeypatch.setattr(kernel_loading, "_asked", set())
    monkeypatch.setattr(
        wp,
        "launch",
        lambda kernel, *given, **named: (launched.append(kernel.module), launch(kernel, *given, **named))[1],
    )
    places = 0.0, 3.0 if output == "distance" else 0.5
    scene = scene_with(device, *[(ball, (x, 0.1, 0.2, 0, 0, 0, 1)) for x in places])
    with regime(warps=warps, packs_results=warps, segments=warps or None):
        scene.intersect([(0, 1)] if output == "distance" else None, output=output)
    assert {module.name for module in launched if "packer" not in module.name} == {module.name for module in loaded}
    crossing = 2 if output == "distance" and wp.get_device(device).is_cuda else 0  # elsewhere where pairs cross
    assert len(set(loaded)) == MODULES[output][warps] + crossing


@pytest.mark.parametrize("faces", [1000, 5000])
def test_modules_compiled_for_a_gpu_ahead_are_those_of_the_launches(faces):
    """A module is compiled for its own size of blocks there: a launch in another would compile it again."""
    gpu = SimpleNamespace(is_cuda=True, is_cpu=False, alias="cuda:0")
    for kernel, block_dim in yes_or_no_kernels(gpu, [faces]):
        assert kernel.module.options["block_dim"] == block_dim, kernel.key
