"""Native code through Warp's experimental `ModuleBuildOptions`: headers for modules of kernels, stubs that call them.

The text of headers is the preamble itself, without folders to include from: Warp hashes text, so that a cached kernel
is the one of these headers wherever the package lies, and modules with and without them share a precompiled header.
A `.cuh` is for both devices, a `.h` that no `.cuh` includes for the CPU.
"""

import inspect
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import warp as wp

FOLDER = Path(__file__).parent / "native"
INCLUDE = re.compile(r'^#(?:pragma once|include "(.+)")\n', re.M)
BASE = ("base/numbers.cuh",)  # what most kernels call


@cache
def read(file: str) -> str:
    return (FOLDER / file).read_text(encoding="utf-8")


def add_header(texts: dict[str, str], file: str) -> None:
    """Add a header to texts, after those that it includes and that are not there."""
    for included in INCLUDE.findall(read(file)):
        if included not in ("", "builtin.h", *texts):
            add_header(texts, included)
    texts.setdefault(file, INCLUDE.sub("", read(file)))


def preamble(files: tuple[str, ...]) -> str:
    """Return the text of headers and what they include, with internal linkage, as the functions that Warp writes."""
    texts: dict[str, str] = {}
    for file in files:
        add_header(texts, file)
    return "namespace ab {\nnamespace {\n" + "".join(texts.values()) + "}\n}\n"


@cache
def build_options(*files: str) -> wp.ModuleBuildOptions:
    cpu, cuda = preamble(files), preamble(tuple(file for file in files if file.endswith(".cuh")))
    return wp.ModuleBuildOptions(extra_cpu_preamble=cpu, extra_cuda_preamble=cuda)


def options(*files: str) -> dict:
    """Return the options of a module whose kernels call functions of `BASE` and of headers that are named."""
    return {"enable_backward": False, "fuse_fp": False, "extra_build_options": build_options(*BASE, *files)}


def func_native(cpu: bool = False) -> Callable[[Callable], wp.Function]:
    """Register a stub of the function of its name and parameters in a header; one for the CPU traps on CUDA.

    The decorator has the name of Warp's, which Warp looks for in a stub's source to see that it returns something.
    """

    def register(stub: Callable) -> wp.Function:
        signature = inspect.signature(stub)
        returns = "" if signature.return_annotation is signature.empty else "return "
        call = f"{returns}ab::{stub.__name__}({', '.join(signature.parameters)});"
        return wp.func_native(f"#if defined(__CUDA_ARCH__)\n__trap();\n#else\n{call}\n#endif\n" if cpu else call)(stub)

    return register


@cache
def constant(name: str) -> int:
    """Return an integer of sizes.h."""
    (value,) = re.findall(rf"^constexpr int {name} = (\d+);$", read("base/sizes.h"), re.M)
    return int(value)
