"""No compiler contracts the arithmetic of signs: every product and sum is rounded by itself."""

import functools
import importlib
import pkgutil
import re

import pytest
import warp as wp
from helpers.orient import sum_of_product_kernel

from warp_abtree import kernels
from warp_abtree.kernels.arithmetic.predicates import EXACT, FLOAT32
from warp_abtree.kernels.traversal import dual_tree, simd, uncertain_pairs
from warp_abtree.kernels.traversal.face_pairs import WITHIN

PASSES = ("resolve_rounded", "float64_filter", "resolve_inexact")


# Approximate on purpose, or without arithmetic.
OTHERS = re.compile(r"\.(progressive|lod|arrays|native)\b")


def test_modules_with_signs_do_not_contract():
    names = [info.name for info in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}.") if not info.ispkg]
    modules = [wp.get_module(importlib.import_module(name).__name__) for name in names if not OTHERS.search(name)]
    makers = [simd.thread_traversal]
    makers += [functools.partial(dual_tree.warp_traversal, for_any=for_any) for for_any in (False, True)]
    modules += [make(int(mode)).module for mode in (EXACT, FLOAT32, WITHIN) for make in makers]
    modules += [getattr(uncertain_pairs, f"{name}_kernel").module for name in PASSES]
    assert [m.name for m in modules if m.options["fuse_fp"] or m.options["fast_math"]] == []


def ptx_of(module, folder):
    """Return the PTX of a module, which needs no GPU, or skip."""
    try:
        wp.compile_aot_module(module, arch=80, module_dir=folder, use_ptx=True)
    except Exception as error:
        pytest.skip(f"no PTX without a GPU here: {error}")
    (path,) = folder.glob("*.ptx")
    return path.read_text()


def find_contraction(text):
    """Return the instructions that are fused, and those that ptxas may fuse since they name no rounding."""
    fused = re.findall(r"\bfma\.\S*f(?:32|64)", text)
    return fused + re.findall(r"\b(?:add|sub|mul)\.(?!rn\b)\S*f(?:32|64)", text)


@pytest.mark.parametrize("fuse_fp", [False, True])
def test_ptx_is_not_contracted(tmp_path, fuse_fp):
    """Every product and sum is rounded by itself; without the option, it would not be."""
    kernel = wp.Kernel(sum_of_product_kernel.func, module=wp.Module(f"ptx_{fuse_fp}", None))
    kernel.module.options.update(enable_backward=False, fuse_fp=fuse_fp)
    assert bool(find_contraction(ptx_of(kernel.module, tmp_path))) == fuse_fp


@pytest.mark.slow
def test_ptx_of_the_traversal_is_not_contracted(tmp_path):
    """The kernels that pose vertices, bound signs and test boxes; without exact signs they have no float64 fma."""
    for for_any in (False, True):
        text = ptx_of(dual_tree.warp_traversal(int(EXACT), for_any).module, tmp_path / f"warp_{for_any}")
        assert len(re.findall(r"\bmul\.rn\.f32", text)) > 50
        # In float32 the kernel itself asks for fused operations, the same on every device.
        assert {x for x in find_contraction(text) if x != "fma.rn.f32"} == set()
    text = ptx_of(uncertain_pairs.float64_filter_kernel.module, tmp_path / "filter")
    assert len(re.findall(r"\bmul\.rn\.f64", text)) > 50
    assert {x for x in find_contraction(text) if x != "fma.rn.f64"} == set()
    text = ptx_of(uncertain_pairs.resolve_rounded_kernel.module, tmp_path / "rounded")
    assert len(re.findall(r"\bmul\.rn\.f64", text)) > 50
    assert find_contraction(text) == []
