"""No compiler contracts the arithmetic of signs: every product and sum is rounded by itself."""

import functools
import importlib
import pkgutil
import re

import pytest
import warp as wp

from warp_abtree import kernels
from warp_abtree.kernels.arithmetic.expansion import two_sum
from warp_abtree.kernels.arithmetic.predicates import EXACT, FLOAT32
from warp_abtree.kernels.traversal import dual_tree, simd, uncertain_pairs
from warp_abtree.kernels.traversal.face_pairs import WITHIN

PASSES = ("resolve_rounded", "float64_filter", "resolve_inexact")
# Approximate on purpose, or without arithmetic.
OTHERS = re.compile(r"\.(progressive|lod|arrays|native)\b")


def test_modules_with_signs_do_not_contract():
    names = [info.name for info in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}.") if not info.ispkg]
    modules = [wp.get_module(importlib.import_module(name).__name__) for name in names if not OTHERS.search(name)]
    makers = [functools.partial(dual_tree.warp_traversal, for_any=for_any) for for_any in (False, True)]
    modules += [
        make(int(mode)).module for mode in (EXACT, FLOAT32, WITHIN) for make in (simd.thread_traversal, *makers)
    ]
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


@wp.kernel
def sum_of_product_kernel(a: wp.array[wp.float64], b: wp.array[wp.float64], high_out: wp.array[wp.float64]):
    i = wp.tid()
    high, _low = two_sum(a[i] * b[i], a[i])
    high_out[i] = high


@pytest.mark.parametrize("fuse_fp", [False, True])
def test_ptx_is_not_contracted(tmp_path, fuse_fp):
    """Every product and sum is rounded by itself; without the option, it would not be."""
    kernel = wp.Kernel(sum_of_product_kernel.func, module=wp.Module(f"ptx_{fuse_fp}", None))
    kernel.module.options.update(enable_backward=False, fuse_fp=fuse_fp)
    assert bool(find_contraction(ptx_of(kernel.module, tmp_path))) == fuse_fp


# Kernel, its products, and the fused operations that it asks for itself, the same on every device.
TRAVERSAL = {
    "all": (lambda: dual_tree.warp_traversal(int(EXACT), False), "f32", {"fma.rn.f32"}),
    "any": (lambda: dual_tree.warp_traversal(int(EXACT), True), "f32", {"fma.rn.f32"}),
    "filter": (lambda: uncertain_pairs.float64_filter_kernel, "f64", {"fma.rn.f64"}),
    "rounded": (lambda: uncertain_pairs.resolve_rounded_kernel, "f64", set()),
}


@pytest.mark.parametrize("case", TRAVERSAL)
@pytest.mark.slow
def test_ptx_of_the_traversal_is_not_contracted(tmp_path, case):
    """The kernels that pose vertices, bound signs and test boxes; without exact signs they have no float64 fma."""
    make, real, asked = TRAVERSAL[case]
    text = ptx_of(make().module, tmp_path)
    assert len(re.findall(rf"\bmul\.rn\.{real}", text)) > 50
    assert set(find_contraction(text)) <= asked
