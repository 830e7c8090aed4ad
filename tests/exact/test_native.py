"""Native code: files compile alone, have their stubs' parameters, and agree with Python on constants."""

import importlib
import inspect
import os
import pkgutil
import re

import pytest
from conftest import slow

from warp_abtree import kernels
from warp_abtree.kernels import native
from warp_abtree.kernels.arithmetic.predicates import BOUND_3D, UNCERTAIN
from warp_abtree.kernels.poses import COORDINATE_MIN

build = pytest.importorskip("warp._src.build", reason="where Warp keeps its compiler")

FILES = sorted(path.name for path in native.FOLDER.iterdir())


def test_every_function_has_one_stub_of_its_name_and_parameters():
    functions = [(file, name, *native.functions(file)[name]) for file in FILES for name in native.functions(file)]
    bodies = {code: (name, parameters) for _, name, parameters, code in functions}
    found = []
    for info in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."):
        for name, function in vars(importlib.import_module(info.name)).items() if info.name != native.__name__ else ():
            snippet = getattr(function, "native_snippet", None)
            if snippet in bodies and function.func.__module__ == info.name:
                assert (name, list(inspect.signature(function.func).parameters)) == bodies[snippet]
                found.append(name)
    assert sorted(found) == sorted(name for _, name, _, _ in functions)


def test_constants_are_those_of_python():
    text = native.read("sizes.h")
    values = {name: float.fromhex(value) for name, value in re.findall(r"constexpr double (\w+) = (\S+);", text)}
    assert values == {"BOUND_3D": float(BOUND_3D), "COORDINATE_MIN": float(COORDINATE_MIN)}
    assert native.constant("UNCERTAIN") == int(UNCERTAIN)


def compile_alone(text, folder):
    """Compile C++ by Warp's own clang; return whether it did."""
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
    assert "struct WideInteger" in native.body("int128.h", "integer_orient3d")
    assert not any("#include" in body for file in FILES for _, body in native.functions(file).values())


@pytest.mark.parametrize("files", [FILES, *slow(*([file] for file in FILES))], ids=lambda files: "+".join(files)[:20])
def test_files_compile_together_and_alone(tmp_path, files):
    assert compile_alone("".join(f'#include "{file}"\n' for file in files), tmp_path)


def test_static_assertions_hold_sizes_together(tmp_path):
    """A list too short for what a warp pushes is refused, so the compiler reads the file at all."""
    text = (native.FOLDER / "sizes.h").read_text()
    assert compile_alone(text, tmp_path)
    for name, value in (("STACK_LENGTH", 500), ("LEAF_PAIR_LENGTH", 100), ("SLOT_ITEMS", 16), ("CPU_STACK_LENGTH", 99)):
        changed = re.sub(rf"({name} =) \d+", rf"\1 {value}", text)
        assert changed != text and not compile_alone(changed, tmp_path), name
