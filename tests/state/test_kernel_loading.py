"""Kernels that several threads compile: each once, all before they are launched, and errors come through."""

import pytest
import warp as wp

from warp_abtree.checks import kernel_loading


def make_kernel(snippet):
    """Return a kernel of a module of its own."""

    @wp.func_native(snippet)
    def write(x: wp.array(dtype=wp.int32)): ...

    @wp.kernel(module="unique", enable_backward=False)
    def write_kernel(x: wp.array(dtype=wp.int32)):
        write(x)

    return write_kernel


def make_kernels(number, code="x.data[0] = {};"):
    """Return kernels that are new to this process, and their block sizes."""
    return [(make_kernel(code.format(100 * number + i)), 32) for i in range(4)]


def loads_of(monkeypatch, cores):
    """Return the list of modules that are loaded from now on."""
    found, force_load = [], wp.force_load
    monkeypatch.setattr(kernel_loading, "core_count", lambda: cores)
    monkeypatch.setattr(wp, "force_load", lambda device, *given: (found.extend(given[0]), force_load(device, *given)))
    return found


def test_each_kernel_is_loaded_once_beside_other_work(device, monkeypatch):
    loaded, device, kernels = loads_of(monkeypatch, 4), wp.get_device(device), make_kernels(1)
    for _ in range(2):
        with kernel_loading.loading(device, [*kernels, kernels[0]]):
            pass
        assert sorted(map(id, loaded)) == sorted(id(kernel.module) for kernel, _ in kernels)
    out = wp.zeros(1, dtype=wp.int32, device=device)
    for i, (kernel, block_dim) in enumerate(kernels):
        wp.launch(kernel, 1, [out], device=device, block_dim=block_dim)
        assert out.numpy()[0] == 100 + i


def test_one_core_waits_for_the_launches(device, monkeypatch):
    loaded = loads_of(monkeypatch, 1)
    with kernel_loading.loading(wp.get_device(device), make_kernels(2)):
        pass
    assert not loaded


def test_an_error_ends_it_and_is_said_again(device, monkeypatch):
    """Of the work beside first, then of the compiler."""
    loaded, device, kernels = loads_of(monkeypatch, 2), wp.get_device(device), make_kernels(3, "no code {};")
    with pytest.raises(KeyError, match="beside"), kernel_loading.loading(device, kernels):
        raise KeyError("beside")
    for _ in range(2):
        loaded.clear()
        with pytest.raises(Exception, match="build failed"), kernel_loading.loading(device, kernels):
            pass
        assert loaded
