"""The floor plan: which module may import which, and how kernels are laid out. Sources are read, not run."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PIPELINE = (
    "checks files mesh progressive tree outward model generation state refine lod broadphase cores poses intersect "
    "contact scene frame_graph turns pose_sweep shard_folder shards nearest convex collision_manager interop manifold "
    "bodies dynamics newton clock control frame cluster "
    "scene_keys scene_folder scene_models scene_control scene_file recording plot waiting report "
    "view_source view_parts picture view_text view_stage view_page view_record view bench_command sweep_command doctor "
    "cli_arguments cli"
).split()
OUTSIDE = PIPELINE[PIPELINE.index("scene_keys") :]  # these use the public API alone, and what is shared
SHARED = {"files"}  # helpers of the library and of its users
CORE_DEPENDENCIES = {"warp", "numpy", "trimesh", "warp_abtree"}
FILE_LINES, KERNEL_LINES = 500, 60

PACKAGE = sorted((ROOT / "warp_abtree").glob("*.py"))
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


def inner_imports(tree, package, names):
    """Yield (part of the package, line): of `import warp_abtree.x` and `from warp_abtree import x`, the part x."""
    for module, name, line in imports(tree, package):
        parts = module.split(".")
        if parts[0] != "warp_abtree":
            continue
        if len(parts) > 1:
            yield parts[1], line
        elif name is None:
            yield "", line
        elif name in names:
            yield name, line
        else:
            yield f".{name}", line  # a name of warp_abtree/__init__.py


def host_faults(name, tree):
    """List what a module of the pipeline imports against its direction."""
    faults = []
    allowed = {"kernels", *PIPELINE[: PIPELINE.index(name)]}
    for part, line in inner_imports(tree, "warp_abtree", {"kernels", *PIPELINE}):
        if part not in allowed:
            faults.append(f"line {line}: {name} imports {part or 'warp_abtree'}, which does not stand above it")
    return faults


def outside_faults(name, tree, public, package="warp_abtree"):
    """List what a user of the package takes from it beyond its public names."""
    faults, aliases = [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname or "warp_abtree" for alias in node.names if alias.name == "warp_abtree"}
    neighbours = SHARED | (set(OUTSIDE[: OUTSIDE.index(name)]) if name in OUTSIDE else set())
    for part, line in inner_imports(tree, package, {"kernels", *PIPELINE}):
        if part and part not in neighbours and part.removeprefix(".") not in public:
            faults.append(f"line {line}: {part} is not public")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            if node.attr not in public and node.attr not in neighbours:
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
        if node.end_lineno - node.lineno + 1 >= KERNEL_LINES:
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


@pytest.mark.parametrize("path", [path for path in PACKAGE if not path.stem.startswith("__")], ids=shown)
def test_host_modules_import_upwards(path):
    assert path.stem in PIPELINE, "a module needs its place in the pipeline"
    tree = parse(path)
    if path.stem in OUTSIDE:
        assert not outside_faults(path.stem, tree, public_names())
        return
    assert not host_faults(path.stem, tree)
    at_import = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    roots = {module.split(".")[0] for module, _, _ in imports(at_import, "warp_abtree")}
    assert roots <= CORE_DEPENDENCIES | sys.stdlib_module_names, "extras are imported where they are used"


@pytest.mark.parametrize("path", USERS, ids=shown)
def test_users_use_the_public_api(path):
    if path.stem == "exact":  # times and judges the kernels themselves, stage by stage
        return
    assert not outside_faults(path.stem, parse(path), public_names(), package="bench")


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
    assert len(path.read_text(encoding="utf-8").splitlines()) <= FILE_LINES


def test_kernel_folders_hold_no_code_in_init():
    body = parse(ROOT / "kernels" / "__init__.py").body
    assert [type(node) for node in body] == [ast.Expr]
    bridge = parse(ROOT / "warp_abtree" / "kernels" / "__init__.py").body
    assert [type(node) for node in bridge] == [ast.Expr, ast.ImportFrom, ast.Assign, ast.If]
    assert sorted(path.name for path in (ROOT / "warp_abtree" / "kernels").glob("*.py")) == ["__init__.py"]


# The rules themselves, on sources that break them.


@pytest.mark.parametrize(
    "source",
    [
        "from warp_abtree.scene import Scene",
        "import warp_abtree.scene as s",
        "def f():\n    from warp_abtree import scene",
        "from .tree import x",
        "from . import intersect",
        "import warp_abtree as ab",
        "from warp_abtree import Model",
    ],
)
def test_rule_of_direction_catches(source):
    assert host_faults("tree", parse(source))
    assert not host_faults("tree", parse("from warp_abtree.mesh import Mesh\nfrom .kernels import mark\nimport numpy"))


@pytest.mark.parametrize(
    "source",
    [
        "from warp_abtree.model import Model",
        "from warp_abtree import Secret",
        "import warp_abtree as ab\nab.state.StatePool",
        "import warp_abtree\nwarp_abtree.Secret",
        "from warp_abtree.kernels import mark",
        "import warp_abtree.mesh",
    ],
)
def test_rule_of_the_public_api_catches(source):
    assert outside_faults("bench", parse(source), {"Model"})
    assert outside_faults("plot", parse(source), {"Model"})
    assert not outside_faults("bench", parse("from warp_abtree.files import atomic_write"), set())
    fine = "import warp_abtree as ab\nfrom warp_abtree import Model\nab.Model.load"
    assert not outside_faults("bench", parse(fine), {"Model"})
    assert not outside_faults("cli", parse("from warp_abtree import plot\nfrom warp_abtree.scene_file import x"), set())
    assert outside_faults("plot", parse("from warp_abtree import cli"), set())


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


@pytest.mark.parametrize("source", ["from .pose import x", "from warp_abtree.mesh import x", "import trimesh"])
def test_rule_of_kernel_imports_catches(source):
    assert kernel_import_faults(parse(source))
    assert not kernel_import_faults(parse("import warp as wp\nfrom warp_abtree.kernels.pose import x\nimport math"))
