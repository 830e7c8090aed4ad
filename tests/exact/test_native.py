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
from warp_abtree.kernels.contacts.near_points import ALONG, NO_DISTANCE
from warp_abtree.kernels.contacts.separation import CLOSEST, LEAST_SEPARATION
from warp_abtree.kernels.distance import within
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE
from warp_abtree.kernels.exact.predicates import BOUND_2D, BOUND_3D, EXACT, FLOAT32, UNCERTAIN
from warp_abtree.kernels.intersect import dual_tree, simd, uncertain_pairs
from warp_abtree.kernels.motion.linear import LinearMotion
from warp_abtree.kernels.motion.path import Motion
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR

DOUBLES = {"BOUND_2D": BOUND_2D, "BOUND_3D": BOUND_3D, "BOUND_DOUBLE": BOUND_DOUBLE, "COORDINATE_MIN": COORDINATE_MIN}
DOUBLES |= {"RELATIVE_ERROR": RELATIVE_ERROR, "SHORTEST_NORMAL": SHORTEST_NORMAL, "CLOSEST": CLOSEST}
DOUBLES |= {"LEAST_SEPARATION": LEAST_SEPARATION, "ALONG": ALONG, "NO_DISTANCE": NO_DISTANCE}
MODULES = [info.name for info in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}.") if not info.ispkg]
PASSES = ("resolve_rounded", "float64_filter", "resolve_inexact")
# Approximate on purpose, or without arithmetic.
OTHERS = re.compile(r"\.(collapse|heap|quadric|vertex_forest|lod|arrays|native)\b")


def test_modules_with_signs_do_not_contract():
    modules = [wp.get_module(importlib.import_module(name).__name__) for name in MODULES if not OTHERS.search(name)]
    makers = [functools.partial(dual_tree.warp_traversal, for_any=for_any) for for_any in (False, True)]
    modules += [make(int(mode)).module for mode in (EXACT, FLOAT32) for make in (simd.thread_traversal, *makers)]
    modules += [make(within.PROVED_APART).module for make in (within.thread_within, within.warp_within)]
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
    high_out[i] = a[i] * b[i] + a[i]


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
FUNCTION = re.compile(r"^[^\s#/][^\n;]*? (\w+)\(((?:[^()]|\(\))*)\) \{", re.M)


def functions_of_headers():
    """Yield the name of every function of a header, its parameters' names, and the header."""
    for file in FILES:
        for name, text in FUNCTION.findall(native.read(file)):
            parts = re.sub(r"<[^<>]*>", "", re.sub(r"<[^<>]*>", "", text)).split(",")
            yield name, [part.split()[-1].lstrip("&") for part in parts if part.strip()], file


def called(function):
    """Return the name of the header's function that a stub calls, or nothing."""
    return "".join(re.findall(r"ab::(\w+)\(", getattr(function, "native_snippet", None) or ""))


def test_every_function_has_one_stub_of_its_name_and_parameters():
    stubs = []
    for name in MODULES:
        for function in vars(importlib.import_module(name)).values():
            if called(function) and function.func.__module__ == name:
                stubs.append((called(function), list(inspect.signature(function.func).parameters)))
                file = next(file for found, _, file in functions_of_headers() if found == called(function))
                assert file.endswith(".h") == ("__trap" in function.native_snippet), "a .h is for the CPU"
    without = [name for name, parameters, _ in functions_of_headers() if (name, parameters) not in stubs]
    assert len(stubs) + len(without) == len([*functions_of_headers()])
    text = "".join(map(native.read, FILES))
    assert [name for name in without if len(re.findall(rf"\b{name}\b", text)) < 2] == [], "no header calls it"


def reached(adjoint, found):
    """Add the functions that a kernel or function calls, and those that they call."""
    for function in adjoint.get_references()[2]:
        overloads = getattr(function, "user_overloads", {}) | getattr(function, "user_templates", {})
        for each in (function, *overloads.values()):
            if hasattr(each, "adj") and each not in found:
                found.add(each)
                reached(each.adj, found)
    return found


MAKERS = {
    "contacts.near_search": lambda made: [made.thread_near_search()],
    "distance.within": lambda made: [make(made.PROVED_APART) for make in (made.thread_within, made.warp_within)],
    "intersect.dual_tree": lambda made: [made.warp_traversal(int(EXACT), False)],
    "intersect.relative_pose": lambda made: [made.relative_poses(False)],
    "intersect.simd": lambda made: [made.thread_traversal(int(EXACT))],
    "io.contact_results": lambda made: [made.contact_packer(wp.float64, True)],
    "motion.group": lambda made: [made.warp_motion_search(kind) for kind in (Motion, LinearMotion)],
    "motion.search": lambda made: [made.thread_motion_search(kind) for kind in (Motion, LinearMotion)],
    "update.block_update": lambda made: [made.state_update(True)],
}


def test_modules_name_the_headers_that_their_kernels_need():
    """No fewer, which would not compile, and no more: each that is parsed takes time before the first answer."""
    header_of = {name: file for name, _, file in functions_of_headers()}
    texts = {file: native.INCLUDE.sub("", native.read(file)) for file in FILES}
    for name in MODULES:
        python, group = importlib.import_module(name), name.removeprefix(f"{kernels.__name__}.")
        found = [value for value in vars(python).values() if isinstance(value, wp.Kernel)]
        found += MAKERS.get(group, lambda made: [])(python)
        needed = [*native.BASE, *(header_of[called(f)] for k in found for f in reached(k.adj, set()) if called(f))]
        expected = {}
        for file in needed:
            native.add_header(expected, file)
        given = [kernel.module.options["extra_build_options"] for kernel in found]
        preambles = {options.extra_cpu_preamble for options in given if options}
        parsed = {file for file in FILES if any(texts[file] in preamble for preamble in preambles)}
        assert not preambles or texts.keys() & parsed == expected.keys(), name


def test_constants_are_those_of_python():
    text = native.read("base/sizes.h")
    values = {name: float.fromhex(value) for name, value in re.findall(r"constexpr double (\w+) = (\S+);", text)}
    assert values == {name: float(value) for name, value in DOUBLES.items()}
    assert native.constant("UNCERTAIN") == int(UNCERTAIN)


def compile_alone(text, folder):
    """Compile C++ by Warp's own clang, with the folder of headers to include from; return whether it did."""
    build = pytest.importorskip("warp._src.build", reason="where Warp keeps its compiler")
    source = folder / "alone.cpp"
    source.write_text(f"#define WP_NO_CRT\n{text}")
    flags = f"-I {native.FOLDER} -Wno-psabi"
    try:
        build.build_cpu(os.fspath(folder / "alone.o"), os.fspath(source), extra_flags=flags)
    except Exception:
        return False
    return True


def test_preamble_holds_each_header_once_after_what_it_includes():
    """Warp hashes the text, so that a change of any file compiles anew. CUDA does not parse headers of the CPU."""
    options = native.options("exact/determinant.cuh", "contacts/contacts.h")["extra_build_options"]
    text, on_cuda = options.extra_cpu_preamble, options.extra_cuda_preamble
    assert "#include" not in text and "#pragma once" not in text
    places = [text.index(f"struct {word} ") for word in ("Points64", "DoubleWords", "Contact64")]
    assert places == sorted(places) and text.count("struct DoubleWords {") == text.count("struct WideInteger {") == 1
    assert "struct Contact64" not in on_cuda and "struct DoubleWords {" in on_cuda


@pytest.mark.parametrize("files", [FILES, *slow(FILES[::-1])], ids=["in order", "reversed"])
def test_files_compile_in_either_order(tmp_path, files):
    """Of two, each is included before the other once, so that none leans on what another happens to include."""
    assert compile_alone("".join(f'#include "{file}"\n' for file in files), tmp_path)


def test_static_assertions_hold_sizes_together(tmp_path):
    """A list too short for what a warp pushes is refused, so the compiler reads the file at all."""
    text = (native.FOLDER / "base/sizes.h").read_text()
    assert compile_alone(text, tmp_path)
    for name, value in (("STACK_LENGTH", 500), ("LEAF_PAIR_LENGTH", 100), ("SLOT_ITEMS", 16), ("CPU_STACK_LENGTH", 99)):
        changed = re.sub(rf"({name} =) \d+", rf"\1 {value}", text)
        assert changed != text and not compile_alone(changed, tmp_path), name
