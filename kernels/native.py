"""C++ and PTX in files: `body` gives one function's text to `wp.func_native`, which Warp hashes and compiles.

A file of kernels/native holds whole functions with the parameters of their Python stubs. Includes inside a function,
structs with static functions among them, become part of its text; those outside serve compilers that read the file
alone.
"""

import re
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent / "native"
INCLUDE = re.compile(r'^ *#include "([\w./]+)"\n', re.M)
FUNCTION = re.compile(r"^[^\s#/][^\n]*? (\w+)\(([^()]*)\) \{\n(.*?)^\}", re.M | re.S)
TEMPLATE = re.compile(r"<[^<>]*>")


@cache
def read(file: str) -> str:
    """Return a file's text as part of a function."""
    return (
        (FOLDER / file).read_text(encoding="utf-8").replace("#pragma once\n", "").replace('#include "builtin.h"\n', "")
    )


def expand(text: str) -> str:
    """Return a text with files of the folder in the place of its includes."""
    return INCLUDE.sub(lambda match: expand(read(match[1])), text)


@cache
def functions(file: str) -> dict[str, tuple[list[str], str]]:
    """Return the parameters' names and the body of every function of a file, by name."""
    found = {}
    for match in FUNCTION.finditer(read(file)):
        parameters = TEMPLATE.sub("", TEMPLATE.sub("", match[2]))
        found[match[1]] = [part.split()[-1] for part in parameters.split(",") if part.strip()], expand(match[3])
    return found


def body(file: str, name: str) -> str:
    """Return the body of a function of a file."""
    return functions(file)[name][1]


@cache
def constant(name: str) -> int:
    """Return an integer of sizes.h."""
    (value,) = re.findall(rf"^constexpr int {name} = (\d+);$", read("base/sizes.h"), re.M)
    return int(value)
