"""python docs/scene_reference.py: write scene_keys.md, every key of a scene file, from its tables and their schema."""

import ast
import inspect
from pathlib import Path

import msgspec

from warp_abtree.app.toml import tables

PAGE = Path(__file__).with_name("scene_keys.md")
HEAD = """# Keys of scene files

What a [scene file](howto_scene.md) may hold, with types, limits and defaults; any other key is refused. Lengths are in
the scene's units, angles in degrees, times in seconds. Made by `docs/scene_reference.py`.
"""
NAMES = {"integer": "whole number", "boolean": "true or false"}
LIMITS = (("exclusiveMinimum", "above"), ("minimum", "from"), ("maximum", "to"))
NO_LIMIT = 2**31 - 1


def describe_type(schema: dict) -> str:
    """Return the type of a schema and its limits in words."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(describe_type(part) for part in schema["anyOf"] if part != {"type": "null"}))
    if "enum" in schema:
        return ", ".join(f'"{value}"' for value in schema["enum"])
    if "$ref" in schema:
        return "table"
    if schema["type"] == "array":
        parts = [describe_type(part) for part in schema.get("prefixItems", [])]
        if not parts:
            return f"list of {describe_type(schema['items'])}"
        return f"[{', '.join(parts)}]" if len(set(parts)) > 1 else f"{len(parts)} of {parts[0]}"
    limits = [f"{word} {schema[key]:,.10g}" for key, word in LIMITS if schema.get(key, NO_LIMIT) != NO_LIMIT]
    return " ".join([NAMES.get(schema["type"], schema["type"]), *limits])


def comments_of(kind) -> dict[str, str]:
    """Return what comments say of the fields of a struct, beside or above them."""
    lines = inspect.getsource(kind).splitlines()
    found = {}
    for node in ast.parse("\n".join(lines)).body[0].body:
        if isinstance(node, ast.AnnAssign):
            first = node.lineno - 1
            while lines[first - 1].strip().startswith("#"):
                first -= 1
            above = [line.strip(" #") for line in lines[first : node.lineno - 1]]
            beside = lines[node.end_lineno - 1].partition("  # ")[2]
            found[node.target.id] = " ".join([*above, beside]).strip(" ,")
    return found


def show_default(schema: dict) -> str:
    """Return the default value of a key, nothing where that is none."""
    value = schema.get("default")
    if isinstance(value, float):
        value = float(f"{value:.6g}")
    return "" if value is None else f"`{msgspec.json.encode(value).decode()}`"


def describe_table(kind, schema: dict) -> list[str]:
    """Return the section of a table: what it is, and its keys."""
    title, _, about = inspect.cleandoc(kind.__doc__).partition("\n")[0].partition(": ")
    lines = [f"## {title}", "", *([about[:1].upper() + about[1:], ""] if about else [])]
    lines += ["| key | type | default | what |", "|---|---|---|---|"]
    told = comments_of(kind)
    for field in msgspec.structs.fields(kind):
        key = schema["properties"][field.encode_name]
        shown = "must be given" if field.encode_name in schema["required"] else show_default(key)
        lines.append(f"| `{field.encode_name}` | {describe_type(key)} | {shown} | {told[field.name]} |")
    return [*lines, ""]


def make_page() -> str:
    """Return the page."""
    _, schemas = msgspec.json.schema_components([tables.SceneTable, tables.ModelTable])
    names = ["HeadTable", "ModelTable", *schemas]
    lines = [HEAD]
    for name in dict.fromkeys(name for name in names if name != "SceneTable"):
        lines += describe_table(getattr(tables, name), schemas[name])
    lines += ["## Shapes", "", "What `shape` of a model may be, and what it takes beside the keys above.", ""]
    lines += ["| shape | takes |", "|---|---|"]
    for name, schema in msgspec.json.schema_components([tables.AnyShape])[1].items():
        own = [f"`{key}` ({describe_type(schema['properties'][key])})" for key in tables.SHAPES[name]]
        lines.append(f"| `{name}` | {', '.join(own)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
