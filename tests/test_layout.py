"""The floor plan: which package may import which, and how files are laid out; and that each rule catches its breaks."""

import ast
import re
import sys

import pytest
from layout_rules import (
    CORE_DEPENDENCIES,
    FILES,
    FOLDER_FILES,
    KERNEL_GROUPS,
    KERNELS,
    MAY_IMPORT,
    NATIVE,
    NATIVE_LINES,
    PACKAGE,
    PUBLIC_MAX,
    ROOT,
    TESTS,
    USERS,
    banned_faults,
    direction_faults,
    documented,
    find_cycle,
    group_faults,
    group_of,
    hidden_import_faults,
    import_edges,
    imports,
    kernel_faults,
    kernel_import_faults,
    native_function_faults,
    outside_faults,
    package_of,
    parse,
    private_faults,
    public_names,
    size_faults,
    snippet_faults,
    struct_faults,
    title_faults,
    twice_defined,
)


def shown(path):
    return str(path.relative_to(ROOT))


def test_every_module_stands_in_a_package():
    at_root = {path.name for path in (ROOT / "warp_abtree").glob("*.py")}
    assert at_root == {"__init__.py", "__main__.py", "names.py", "testing.py"}
    folders = {path.name for path in (ROOT / "warp_abtree").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == {*MAY_IMPORT, "kernels"}
    taken = {module.split(".")[1] for module, _, _ in imports(parse(ROOT / "warp_abtree" / "names.py"), "warp_abtree")}
    assert "app" not in taken, "nothing imports app"


def faults_in(paths, *rules):
    """Return what rules, functions of a path, its tree and its text, find in each file where they find something."""
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    found = {shown(path): [rule(path, parse(path), text) for rule in rules] for path, text in texts.items()}
    return {path: faults for path, faults in found.items() if any(faults)}


def extras_at_import(path, tree, text):
    """List packages beside those that the core needs which a module imports at its top."""
    at_import = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    roots = {module.split(".")[0] for module, _, _ in imports(at_import, package_of(path))}
    allowed = CORE_DEPENDENCIES | sys.stdlib_module_names
    return [] if package_of(path).split(".")[1] == "app" else sorted(roots - allowed)


def test_packages_import_those_below():
    rules = (
        lambda path, tree, text: direction_faults(tree, package_of(path)),
        lambda path, tree, text: private_faults(tree),
        extras_at_import,
    )
    assert faults_in(PACKAGE, *rules) == {}


def test_no_module_imports_itself_by_way_of_others():
    edges = {package_of(path) + "." + path.stem: import_edges(path) for path in PACKAGE}
    assert find_cycle(edges) == []


def test_users_use_the_public_api():
    names, open_names = {*public_names(), "__version__"}, documented()
    rules = (
        lambda path, tree, text: outside_faults(tree, names, "bench", open_names),
        lambda path, tree, text: private_faults(tree),
    )
    assert faults_in(USERS, *rules) == {}


def test_public_names_are_those_of_the_reference():
    names = public_names()
    assert len(names) == len(set(names)) <= PUBLIC_MAX and names == sorted(names)
    pages = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").rglob("*.md")))
    entries = re.findall(r"^::: warp_abtree\.(\w+)$", pages, re.M)
    assert sorted(entries) == names, "each public name stands once in the API reference"


def test_kernels():
    rules = (
        lambda path, tree, text: kernel_import_faults(tree),
        lambda path, tree, text: kernel_faults(tree),
        lambda path, tree, text: struct_faults(tree, text),
        lambda path, tree, text: snippet_faults(tree),
        lambda path, tree, text: group_faults(tree, group_of(path)),
    )
    assert faults_in(KERNELS, *rules) == {}


def test_one_subject_has_one_word():
    groups = {path.name for path in (ROOT / "kernels").iterdir() if path.is_dir()} - {"native", "__pycache__"}
    assert groups == {*KERNEL_GROUPS}
    assert {path.parent.name for path in NATIVE} <= groups
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders <= groups | {*MAY_IMPORT, "bench", "helpers", "oracles"}


@pytest.mark.parametrize("paths", [PACKAGE, KERNELS, USERS, TESTS], ids=["package", "kernels", "users", "tests"])
def test_files(paths):
    rules = (
        lambda path, tree, text: hidden_import_faults(tree),
        lambda path, tree, text: size_faults(tree, text),
        lambda path, tree, text: banned_faults(tree),
        lambda path, tree, text: title_faults(text),
    )
    assert faults_in(paths, *rules) == {}


def test_a_name_has_one_definition():
    assert twice_defined({shown(path): parse(path) for path in (*PACKAGE, *KERNELS)}) == {}


def test_folders_hold_few_files():
    folders = {path.parent for path in (*FILES, *NATIVE)}
    counts = {shown(folder): len([p for p in (*FILES, *NATIVE) if p.parent == folder]) for folder in folders}
    full = {folder: count for folder, count in counts.items() if count > FOLDER_FILES + 1}
    assert full == {}, "__init__.py apart"


def test_files_of_tests_have_names_of_their_own():
    names = [path.name for path in TESTS if path.name.startswith("test_")]
    assert sorted(names) == sorted(set(names)), "pytest imports them by their names"


def test_native_code_stands_in_its_folder():
    assert all(path.is_relative_to(ROOT / "kernels" / "native") for path in NATIVE)
    lengths = {shown(path): len(path.read_text(encoding="utf-8").splitlines()) for path in NATIVE}
    assert {name: count for name, count in lengths.items() if count > NATIVE_LINES} == {}
    assert [shown(path) for path in NATIVE if title_faults(path.read_text(encoding="utf-8"))] == []
    assert [fault for path in NATIVE for fault in native_function_faults(path.read_text(encoding="utf-8"))] == []


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


@pytest.mark.parametrize(
    "source",
    [
        'importlib.import_module("warp_abtree.mesh")',
        '__import__(f"warp_abtree.{name}")',
        "from test_scene import everything",
        "import kernels.mark",
    ],
)
def test_rule_of_hidden_imports_catches(source):
    assert hidden_import_faults(parse(source))
    assert not hidden_import_faults(parse('importlib.import_module("tomllib")\nfrom helpers.scenes import everything'))


@pytest.mark.parametrize(
    "source", ["scene._states", "frame.query._given = 1", "from warp_abtree.scene.sweep import _kept", "sweep._kept"]
)
def test_rule_of_private_names_catches(source):
    assert private_faults(parse(source))
    fine = "class A:\n    def f(self, other):\n        self._x = other._x\n        super()._y()\n        os._exit(0)"
    assert not private_faults(parse(fine))


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
    ],
)
def test_rule_of_kernels_catches(source):
    assert kernel_faults(parse(source))
    assert not kernel_faults(parse("@wp.kernel\ndef f_kernel(a: int, b_inout: int, c_out: int):\n    pass"))


@pytest.mark.parametrize("source", ["from .pose import x", "from warp_abtree.model.mesh import x", "import trimesh"])
def test_rule_of_kernel_imports_catches(source):
    assert kernel_import_faults(parse(source))
    assert not kernel_import_faults(
        parse("import warp as wp\nfrom warp_abtree.kernels.base.poses import x\nimport math")
    )


@pytest.mark.parametrize(
    "source",
    [
        "x = 1\n" * 401,
        "def f():\n" + "    pass\n" * 61,
        f"def f(self, {', '.join(f'a{i}' for i in range(11))}):\n    pass",
    ],
)
def test_rule_of_sizes_catches(source):
    assert size_faults(parse(source), source)
    named = ", ".join(f"a{i}" for i in range(11))
    fine = "x = 1\n" * 330 + f"def f(*, {named}):\n" + "    pass\n" * 60
    assert not size_faults(parse(fine), fine)


@pytest.mark.parametrize(
    "source", ["@wp.struct\nclass A:\n    x: int  # [m]\n    y: int", "@wp.func\ndef pack_item(a: int):\n    return a"]
)
def test_rule_of_structs_and_words_catches(source):
    assert struct_faults(parse(source), source)
    fine = '"""\n[ x | y ]"""\n@wp.struct\nclass A:\n    # how far [m]\n    x: int\ndef pack_x(a):\n    pass'
    assert not struct_faults(parse(fine), fine)


def test_rule_of_native_code_catches():
    for begin, end in (
        ("int f(int x) {", "}"),
        ("struct A {\n    void f(int x) const {", "    }\n};"),
    ):
        assert native_function_faults(f"{begin}\n" + "        ++x;\n" * 79 + end)
        assert not native_function_faults(f"{begin}\n" + "        ++x;\n" * 78 + end)
    assert snippet_faults(parse('CODE = """' + "int x = 0;\n" * 16 + '"""'))
    assert not snippet_faults(parse('CODE = """' + "int x = 0;\n" * 15 + '"""\n"""' + "Prose; more.\n" * 20 + '"""'))


@pytest.mark.parametrize("source", ["rung = 1", "def settle_hard_kernel(): pass", "self.wish", "class Mailbox: pass"])
def test_rule_of_names_catches(source):
    assert banned_faults(parse(source))
    assert not banned_faults(parse("rungs_of_the_sea = strung = 1".replace("rungs_of_the_sea", "sprung")))


@pytest.mark.parametrize(
    "source",
    [
        '"""Whether two boxes overlap."""',
        '"""How far."""\nx = 1',
        '"""\nWhich pairs meet."""',
        "x = 1",
        "// How wide.\n",
    ],
)
def test_rule_of_titles_catches(source):
    assert title_faults(source)
    assert not title_faults('"""Whichever: even-odd ray test.\n\nWhether a point is inside."""')
    assert not title_faults("// Slabs.\n// How wide.\n")


@pytest.mark.parametrize(
    "source", ["def f():\n    pass", "class f:\n    pass", "f = 1", "e, f = 1, 2", "e, (f, g) = x", "f: int = 1"]
)
def test_rule_of_names_of_one_meaning_catches(source):
    fine = "from a import f\n_f = 1\nMODULE_OPTIONS = {}\ndef h():\n    f = 1"
    assert twice_defined({"a": parse(source), "b": parse("f = 2"), "c": parse(fine)}) == {"f": ["a", "b"]}
    assert twice_defined({"a": parse(source), "c": parse(fine), "d": parse("MODULE_OPTIONS = f.x = _f = 1")}) == {}


@pytest.mark.parametrize(
    "source",
    [
        "from warp_abtree.kernels.intersect.face_pairs import Hits",
        "from warp_abtree.kernels.distance import frame",
        "from warp_abtree.kernels import contacts",
        "def f():\n    from warp_abtree.kernels.io.results import pack_pair_kernel",
    ],
)
def test_rule_of_kernel_groups_catches(source):
    assert group_faults(parse(source), "search") and not group_faults(parse(source), "io")


def test_rule_of_cycles_sees_imports_inside_functions():
    path = ROOT / "warp_abtree" / "model" / "inside.py"
    source = "def f():\n    from warp_abtree.model import tree"
    assert "warp_abtree.model.tree" in import_edges(path, parse(source))
