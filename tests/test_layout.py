"""The floor plan: which package may import which, and how files are laid out. Sources are read, not run."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Each package may import itself, `checks`, kernels, and what stands in its row.
CORE = ["checks", "model", "state", "query", "scene", "lod", "simulate"]
MAY_IMPORT = {name: set(CORE[:place]) for place, name in enumerate(CORE)}
MAY_IMPORT |= {"interop": set(CORE), "jobs": set(CORE), "app": {*CORE, "interop", "jobs"}}
CORE_DEPENDENCIES = {"warp", "numpy", "trimesh", "warp_abtree"}
FILE_LINES, FOLDER_FILES, FUNCTION_LINES = 500, 12, 60

PACKAGE = sorted(path for name in MAY_IMPORT for path in (ROOT / "warp_abtree" / name).rglob("*.py"))
KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
USERS = sorted(path for folder in ("bench", "scenes") for path in (ROOT / folder).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))


def parse(source):
    return ast.parse(source.read_text(encoding="utf-8") if isinstance(source, Path) else source)


def imports(tree, package):
    """Yield every imported (module, name, line); name is None for `import module`, relative imports made absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, None, node.lineno
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                yield module, alias.name, node.lineno


def package_of(path):
    """Return the dotted package of a module of warp_abtree."""
    return ".".join(path.relative_to(ROOT).parent.parts)


def direction_faults(tree, package):
    """List what a module imports of warp_abtree against the direction of the packages."""
    faults = []
    own = package.split(".")[1]
    for module, name, line in imports(tree, package):
        parts = module.split(".")
        if parts[0] != "warp_abtree":
            continue
        if len(parts) == 1:
            faults.append(f"line {line}: imports {name or module} of the package's root")
        elif parts[1] not in {own, "kernels", *MAY_IMPORT[own]}:
            faults.append(f"line {line}: {own} imports {parts[1]}")
    return faults


def dynamic_import_faults(tree):
    """List imports by a string of what is the project's own."""
    faults = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            if node.args and "warp_abtree" in ast.unparse(node.args[0]):
                faults.append(f"line {node.lineno}: {ast.unparse(node)}")
    return faults


def import_edges(path):
    """Return the modules of warp_abtree that a module imports when it is itself imported."""
    top = ast.Module([node for node in parse(path).body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    return {
        found
        for module, name, _ in imports(top, package_of(path))
        if module.split(".")[0] == "warp_abtree"
        for found in [f"{module}.{name}", module]
    }


def find_cycle(edges):
    """Return modules that import one another in a circle, [] where there is none."""
    done, trail = set(), []

    def walk(module):
        if module in trail:
            return trail[trail.index(module) :]
        if module in done or module not in edges:
            return []
        trail.append(module)
        for other in sorted(edges[module] & edges.keys()):
            if other != module and (found := walk(other)):
                return found
        done.add(trail.pop())
        return []

    return next((found for module in sorted(edges) if (found := walk(module))), [])


def documented():
    """Return the dotted names of the API reference."""
    pages = (path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").rglob("*.md")))
    return {name for page in pages for name in re.findall(r"^::: ([\w.]+)$", page, re.M)}


def outside_faults(tree, public, package, known=frozenset()):
    """List what a user of the library takes from it beyond its public names and the modules of the API reference."""
    public, faults, aliases = {*public, "testing"}, [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname or "warp_abtree" for alias in node.names if alias.name == "warp_abtree"}
    for module, name, line in imports(tree, package):
        parts = module.split(".")
        if parts[0] != "warp_abtree" or parts[1:2] in (["testing"], ["checks"]) or {module, f"{module}.{name}"} & known:
            continue
        if len(parts) > 1 or (name is not None and name not in public):
            faults.append(f"line {line}: {module}{'.' + name if name else ''} is not public")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            if node.attr not in public:
                faults.append(f"line {node.lineno}: warp_abtree.{node.attr} is not public")
    return faults


def kernel_import_faults(tree):
    """List imports of a kernel file that leave kernels/, or are relative."""
    faults = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            faults.append(f"line {node.lineno}: relative import")
    for module, name, line in imports(tree, "warp_abtree.kernels"):
        inside = module.startswith("warp_abtree.kernels") or (module == "warp_abtree" and name == "kernels")
        root = module.split(".")[0]
        if not inside and root not in {"warp", "numpy"} and root not in sys.stdlib_module_names:
            faults.append(f"line {line}: imports {module}")
    return faults


def is_kernel(function):
    decorators = [node.func if isinstance(node, ast.Call) else node for node in function.decorator_list]
    return any(ast.unparse(node) in ("wp.kernel", "warp.kernel", "kernel") for node in decorators)


def kernel_faults(tree):
    """List kernels that are misnamed, too long, or whose outputs do not come last."""
    faults = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        if is_kernel(node) != node.name.endswith("_kernel"):
            faults.append(f"{node.name}: kernels, and only kernels, are named *_kernel")
        if not is_kernel(node):
            continue
        if node.end_lineno - node.lineno + 1 >= FUNCTION_LINES:
            faults.append(f"{node.name}: {node.end_lineno - node.lineno + 1} lines")
        names = [argument.arg for argument in node.args.args]
        group = [2 if name.endswith("_out") else 1 if name.endswith("_inout") else 0 for name in names]
        if group != sorted(group):
            faults.append(f"{node.name}: arguments {names} are not in the order inputs, _inout, _out")
    return faults


def public_names():
    for node in parse(ROOT / "warp_abtree" / "__init__.py").body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return {*ast.literal_eval(node.value), "__version__"}
    return {"__version__"}


def shown(path):
    return str(path.relative_to(ROOT))


def test_every_module_stands_in_a_package():
    at_root = {path.name for path in (ROOT / "warp_abtree").glob("*.py")}
    assert at_root == {"__init__.py", "__main__.py", "testing.py"}
    folders = {path.name for path in (ROOT / "warp_abtree").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == {*MAY_IMPORT, "kernels"}


@pytest.mark.parametrize("path", PACKAGE, ids=shown)
def test_packages_import_those_below(path):
    tree = parse(path)
    assert not direction_faults(tree, package_of(path))
    if package_of(path).split(".")[1] == "app":
        return
    at_import = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    roots = {module.split(".")[0] for module, _, _ in imports(at_import, package_of(path))}
    assert roots <= CORE_DEPENDENCIES | sys.stdlib_module_names, "extras are imported where they are used"


def test_no_module_imports_itself_by_way_of_others():
    edges = {package_of(path) + "." + path.stem: import_edges(path) for path in PACKAGE}
    assert find_cycle(edges) == []


@pytest.mark.parametrize("path", USERS, ids=shown)
def test_users_use_the_public_api(path):
    if path == ROOT / "bench" / "inside.py":  # what bench takes from the inside stands there alone
        return
    assert not outside_faults(parse(path), public_names(), "bench", documented())


@pytest.mark.parametrize("path", KERNELS, ids=shown)
def test_kernels(path):
    tree = parse(path)
    assert not kernel_import_faults(tree)
    assert not kernel_faults(tree)


@pytest.mark.parametrize("path", [*PACKAGE, *KERNELS, *USERS, *TESTS], ids=shown)
def test_files(path):
    tree = parse(path)
    assert not [line for module, _, line in imports(tree, "x") if module.split(".")[0] == "kernels"], (
        "import warp_abtree.kernels, or every kernel exists twice"
    )
    assert not [line for module, _, line in imports(tree, "x") if module.split(".")[-1].startswith("test_")]
    assert path.name == "test_predicates.py" or not dynamic_import_faults(tree)
    assert len(path.read_text(encoding="utf-8").splitlines()) <= FILE_LINES


def test_kernel_folders_hold_no_code_in_init():
    for path in (ROOT / "kernels").rglob("__init__.py"):
        assert [type(node) for node in parse(path).body] == [ast.Expr]
    bridge = parse(ROOT / "warp_abtree" / "kernels" / "__init__.py").body
    assert [type(node) for node in bridge] == [ast.Expr, ast.ImportFrom, ast.Assign, ast.If]
    assert sorted(path.name for path in (ROOT / "warp_abtree" / "kernels").glob("*.py")) == ["__init__.py"]


# The rules themselves, on sources that break them.


@pytest.mark.parametrize(
    "source",
    [
        "from warp_abtree.scene.scene import Scene",
        "import warp_abtree.scene.scene as s",
        "def f():\n    from warp_abtree.app import cli",
        "from ..query import x",
        "from .. import query",
        "import warp_abtree as ab",
        "from warp_abtree import Model",
    ],
)
def test_rule_of_direction_catches(source):
    assert direction_faults(parse(source), "warp_abtree.state")
    fine = "from warp_abtree.model.mesh import Mesh\nfrom .arrays import x\nfrom warp_abtree.kernels import y"
    assert not direction_faults(parse(fine), "warp_abtree.state")


def test_rule_of_cycles_catches():
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == ["a", "b", "c"]
    assert not find_cycle({"a": {"b", "c"}, "b": {"c"}, "c": {"numpy"}})


def test_rule_of_dynamic_imports_catches():
    assert dynamic_import_faults(parse('importlib.import_module("warp_abtree.mesh")'))
    assert dynamic_import_faults(parse('__import__(f"warp_abtree.{name}")'))
    assert not dynamic_import_faults(parse('importlib.import_module("tomllib")'))


@pytest.mark.parametrize(
    "source",
    [
        "from warp_abtree.model.model import Model",
        "from warp_abtree import Secret",
        "import warp_abtree as ab\nab.state.StatePool",
        "import warp_abtree\nwarp_abtree.Secret",
        "from warp_abtree.kernels import mark",
        "import warp_abtree.model.mesh",
    ],
)
def test_rule_of_the_public_api_catches(source):
    assert outside_faults(parse(source), {"Model"}, "bench")
    fine = (
        "import warp_abtree as ab\nfrom warp_abtree import Model\nab.Model.load\nfrom warp_abtree.app import load_scene"
    )
    assert not outside_faults(parse(fine), {"Model"}, "bench", {"warp_abtree.app.load_scene"})


@pytest.mark.parametrize(
    "source",
    [
        "@wp.kernel\ndef f_kernel(a_out: int, b: int):\n    pass",
        "@wp.kernel\ndef f_kernel(a_out: int, b_inout: int):\n    pass",
        "@wp.kernel(module='unique')\ndef f_kernel(a_inout: int, b: int):\n    pass",
        "@wp.kernel\ndef f(a: int):\n    pass",
        "@wp.func\ndef f_kernel(a: int):\n    pass",
        "@wp.kernel\ndef f_kernel(a: int):\n" + "    pass\n" * 60,
    ],
)
def test_rule_of_kernels_catches(source):
    assert kernel_faults(parse(source))
    assert not kernel_faults(parse("@wp.kernel\ndef f_kernel(a: int, b_inout: int, c_out: int):\n    pass"))


@pytest.mark.parametrize("source", ["from .pose import x", "from warp_abtree.model.mesh import x", "import trimesh"])
def test_rule_of_kernel_imports_catches(source):
    assert kernel_import_faults(parse(source))
    assert not kernel_import_faults(parse("import warp as wp\nfrom warp_abtree.kernels.poses import x\nimport math"))
