"""Compiled code: no arithmetic of signs is contracted; native files compile alone and agree with their stubs."""

import functools
import importlib
import inspect
import os
import pkgutil
import re

import pytest
import warp as wp
from conftest import slow

from warp_abtree import kernels
from warp_abtree.kernels import native
from warp_abtree.kernels.base.poses import COORDINATE_MIN
from warp_abtree.kernels.contacts.contact import SHORTEST_NORMAL
from warp_abtree.kernels.contacts.separation import CLOSEST, LEAST_SEPARATION
from warp_abtree.kernels.contacts.travel import LEAST_SINE_SQUARED
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE
from warp_abtree.kernels.exact.expansion import two_sum
from warp_abtree.kernels.exact.predicates import BOUND_2D, BOUND_3D, EXACT, FLOAT32, UNCERTAIN
from warp_abtree.kernels.intersect import dual_tree, simd, uncertain_pairs
from warp_abtree.kernels.intersect.face_pairs import WITHIN
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR

DOUBLES = {
    "BOUND_2D": BOUND_2D,
    "BOUND_3D": BOUND_3D,
    "BOUND_DOUBLE": BOUND_DOUBLE,
    "COORDINATE_MIN": COORDINATE_MIN,
    "LEAST_SINE_SQUARED": LEAST_SINE_SQUARED,
    "RELATIVE_ERROR": RELATIVE_ERROR,
    "SHORTEST_NORMAL": SHORTEST_NORMAL,
    "LEAST_SEPARATION": LEAST_SEPARATION,
    "CLOSEST": CLOSEST,
}
PASSES = ("resolve_rounded", "float64_filter", "resolve_inexact")
# Approximate on purpose, or without arithmetic.
OTHERS = re.compile(r"\.(collapse|heap|quadric|vertex_forest|lod|arrays|native)\b")


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


FILES = sorted(path.relative_to(native.FOLDER).as_posix() for path in native.FOLDER.rglob("*.*h"))


def test_every_function_has_one_stub_of_its_name_and_parameters():
    functions = [(file, name, *native.functions(file)[name]) for file in FILES for name in native.functions(file)]
    written = [(name, parameters, code) for _, name, parameters, code in functions]
    bodies = {code for _, _, code in written}
    found = []
    for info in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."):
        for name, function in vars(importlib.import_module(info.name)).items() if info.name != native.__name__ else ():
            snippet = getattr(function, "native_snippet", None)
            if snippet in bodies and function.func.__module__ == info.name:
                assert (name, list(inspect.signature(function.func).parameters), snippet) in written
                found.append(name)
    assert sorted(found) == sorted(name for _, name, _, _ in functions)


def test_constants_are_those_of_python():
    text = native.read("base/sizes.h")
    values = {name: float.fromhex(value) for name, value in re.findall(r"constexpr double (\w+) = (\S+);", text)}
    assert values == {name: float(value) for name, value in DOUBLES.items()}
    assert native.constant("UNCERTAIN") == int(UNCERTAIN)


def compile_alone(text, folder):
    """Compile C++ by Warp's own clang; return whether it did."""
    build = pytest.importorskip("warp._src.build", reason="where Warp keeps its compiler")
    source = folder / "alone.cpp"
    source.write_text(f"#define WP_NO_CRT\n{text}")
    flags = f"-I {native.FOLDER} -Wno-psabi"
    try:
        build.build_cpu(os.fspath(folder / "alone.o"), os.fspath(source), extra_flags=flags)
    except Exception:
        return False
    return True


def test_included_files_are_part_of_the_text():
    """Warp hashes the text, so that a change of any file compiles anew."""
    assert "struct WideInteger" in native.body("exact/int128.h", "integer_orient3d")
    assert not any("#include" in body for file in FILES for _, body in native.functions(file).values())


@pytest.mark.parametrize("files", [FILES, *slow(*([file] for file in FILES))], ids=lambda files: "+".join(files)[:20])
def test_files_compile_together_and_alone(tmp_path, files):
    assert compile_alone("".join(f'#include "{file}"\n' for file in files), tmp_path)


def test_static_assertions_hold_sizes_together(tmp_path):
    """A list too short for what a warp pushes is refused, so the compiler reads the file at all."""
    text = (native.FOLDER / "base/sizes.h").read_text()
    assert compile_alone(text, tmp_path)
    for name, value in (("STACK_LENGTH", 500), ("LEAF_PAIR_LENGTH", 100), ("SLOT_ITEMS", 16), ("CPU_STACK_LENGTH", 99)):
        changed = re.sub(rf"({name} =) \d+", rf"\1 {value}", text)
        assert changed != text and not compile_alone(changed, tmp_path), name
