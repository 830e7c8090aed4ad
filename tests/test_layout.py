"""The floor plan: which package may import which, and how files are laid out; and that each rule catches its breaks."""

import ast
import gc
import sys

import layout_rules as rules
import pytest
from layout_rules import FILES, KERNELS, NATIVE, PACKAGE, ROOT, TESTS, USERS, imports, package_of, parse


@pytest.fixture(scope="module", autouse=True)
def no_collection():
    """Keep the collector from the syntax trees of all files, which are held as long as this module's tests run."""
    gc.disable()
    yield
    gc.enable()
    parse.cache_clear()
    rules.walk.cache_clear()


def shown(path):
    return str(path.relative_to(ROOT))


def test_every_module_stands_in_a_package():
    at_root = {path.name for path in (ROOT / "warp_abtree").glob("*.py")}
    assert at_root == {"__init__.py", "__main__.py", "names.py", "testing.py"}
    folders = {path.name for path in (ROOT / "warp_abtree").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == {*rules.MAY_IMPORT, "kernels"}
    taken = {module.split(".")[1] for module, _, _ in imports(parse(ROOT / "warp_abtree" / "names.py"), "warp_abtree")}
    assert "app" not in taken, "nothing imports app"


def faults_in(paths, *of_tree, more=lambda path, text: []):
    """Return the faults of each file that has any, by rules of its tree, and by more of its path and text."""
    found = {}
    for path in paths:
        faults = [fault for rule in of_tree for fault in rule(parse(path))]
        faults += more(path, path.read_text(encoding="utf-8"))
        found |= {shown(path): faults} if faults else {}
    return found


def package_faults(path, text):
    """List imports against the direction of the packages, and those at its top of what the core does not need."""
    tree, package = parse(path), package_of(path)
    at_import = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    roots = {module.split(".")[0] for module, _, _ in imports(at_import, package)}
    extras = sorted(roots - rules.CORE_DEPENDENCIES - sys.stdlib_module_names)
    return rules.direction_faults(tree, package) + (extras if package.split(".")[1] != "app" else [])


def test_packages_import_those_below():
    assert faults_in(PACKAGE, rules.private_faults, more=package_faults) == {}


def test_no_module_imports_itself_by_way_of_others():
    edges = {package_of(path) + "." + path.stem: rules.import_edges(path) for path in PACKAGE}
    assert rules.find_cycle(edges) == []


def test_users_use_the_public_api():
    names, known = {*rules.public_names(), "__version__"}, rules.documented()
    used = faults_in(USERS, rules.private_faults, lambda tree: rules.outside_faults(tree, names, "bench", known))
    assert used == {}


def test_public_names_are_few():
    names = rules.public_names()
    assert len(names) == len(set(names)) <= rules.PUBLIC_MAX and names == sorted(names)


def test_kernels():
    def more(path, text):
        return rules.struct_faults(parse(path), text) + rules.group_faults(parse(path), rules.group_of(path))

    of_tree = rules.kernel_import_faults, rules.kernel_faults, rules.snippet_faults
    assert faults_in(KERNELS, *of_tree, more=more) == {}


def test_one_subject_has_one_word():
    groups = {path.name for path in (ROOT / "kernels").iterdir() if path.is_dir()} - {"native", "__pycache__"}
    assert groups == {*rules.KERNEL_GROUPS}
    assert {path.parent.name for path in NATIVE} <= groups
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders <= groups | {*rules.MAY_IMPORT, "bench", "helpers", "oracles"}


@pytest.mark.parametrize("paths", [PACKAGE, KERNELS, USERS, TESTS], ids=["package", "kernels", "users", "tests"])
def test_files(paths):
    def more(path, text):
        return rules.size_faults(parse(path), text) + rules.title_faults(text)

    assert faults_in(paths, rules.hidden_import_faults, rules.banned_faults, more=more) == {}


def test_a_name_has_one_definition():
    assert rules.twice_defined({shown(path): parse(path) for path in (*PACKAGE, *KERNELS)}) == {}


def test_folders_hold_few_files():
    folders = {path.parent for path in (*FILES, *NATIVE)}
    counts = {shown(folder): len([p for p in (*FILES, *NATIVE) if p.parent == folder]) for folder in folders}
    full = {folder: count for folder, count in counts.items() if count > rules.FOLDER_FILES + 1}
    assert full == {}, "__init__.py apart"
    names = [path.name for path in TESTS if path.name.startswith("test_")]
    assert sorted(names) == sorted(set(names)), "pytest imports them by their names"


def test_native_code_stands_in_its_folder():
    assert all(path.is_relative_to(ROOT / "kernels" / "native") for path in NATIVE)
    texts = {shown(path): path.read_text(encoding="utf-8") for path in NATIVE}
    assert [name for name, text in texts.items() if len(text.splitlines()) > rules.NATIVE_LINES] == []
    assert [name for name, text in texts.items() if rules.title_faults(text)] == []
    assert [fault for text in texts.values() for fault in rules.native_function_faults(text)] == []


def test_kernel_folders_hold_no_code_in_init():
    for path in (ROOT / "kernels").rglob("__init__.py"):
        assert [type(node) for node in parse(path).body] == [ast.Expr]
    bridge = parse(ROOT / "warp_abtree" / "kernels" / "__init__.py").body
    assert [type(node) for node in bridge] == [ast.Expr, ast.ImportFrom, ast.Assign, ast.If]
    assert sorted(path.name for path in (ROOT / "warp_abtree" / "kernels").glob("*.py")) == ["__init__.py"]


ELEVEN = ", ".join(f"a{i}" for i in range(11))
METHOD = "struct A {{\n    void f(int x) const {{\n{}    }}\n}};".format
FUNCTION = "int f(int x) {{\n{}}}".format


# The rules themselves: what finds their breaks, sources that break them, and sources that do not.
RULES = {
    "direction": (
        lambda source: rules.direction_faults(parse(source), "warp_abtree.state"),
        [
            "from warp_abtree.scene.scene import Scene",
            "import warp_abtree.scene.scene as s",
            "def f():\n    from warp_abtree.app import cli",
            "from .. import query",
            "import warp_abtree as ab",
        ],
        ["from warp_abtree.model.mesh import Mesh\nfrom .arrays import x\nfrom warp_abtree.kernels import y"],
    ),
    "hidden imports": (
        lambda source: rules.hidden_import_faults(parse(source)),
        [
            'importlib.import_module("warp_abtree.mesh")',
            '__import__(f"warp_abtree.{name}")',
            "from test_scene import everything",
            "import kernels.mark",
        ],
        ['importlib.import_module("tomllib")\nfrom helpers.scenes import everything'],
    ),
    "private names": (
        lambda source: rules.private_faults(parse(source)),
        ["scene._states", "frame.query._given = 1", "from warp_abtree.scene.sweep import _kept", "sweep._kept"],
        ["class A:\n    def f(self, other):\n        self._x = other._x\n        super()._y()\n        os._exit(0)"],
    ),
    "public API": (
        lambda source: rules.outside_faults(parse(source), {"Model"}, "bench", {"warp_abtree.app.load_scene"}),
        [
            "from warp_abtree.model.model import Model",
            "from warp_abtree import Secret",
            "import warp_abtree as ab\nab.state.StatePool",
            "import warp_abtree.model.mesh",
        ],
        [
            "import warp_abtree as ab\nfrom warp_abtree import Model\nab.Model.load",
            "from warp_abtree.app import load_scene",
        ],
    ),
    "kernels": (
        lambda source: rules.kernel_faults(parse(source)),
        [
            "@wp.kernel\ndef f_kernel(a_out: int, b_inout: int):\n    pass",
            "@wp.kernel(module='unique')\ndef f_kernel(a_inout: int, b: int):\n    pass",
            "@wp.kernel\ndef f(a: int):\n    pass",
            "@wp.func\ndef f_kernel(a: int):\n    pass",
        ],
        ["@wp.kernel\ndef f_kernel(a: int, b_inout: int, c_out: int):\n    pass"],
    ),
    "imports of kernels": (
        lambda source: rules.kernel_import_faults(parse(source)),
        ["from .pose import x", "from warp_abtree.model.mesh import x", "import trimesh"],
        ["import warp as wp\nfrom warp_abtree.kernels.base.poses import x\nimport math"],
    ),
    "sizes": (
        lambda source: rules.size_faults(parse(source), source),
        ["x = 1\n" * 401, "def f():\n" + "    pass\n" * 61, f"def f(self, {ELEVEN}):\n    pass"],
        ["x = 1\n" * 330 + f"def f(*, {ELEVEN}):\n" + "    pass\n" * 60],
    ),
    "structs and words": (
        lambda source: rules.struct_faults(parse(source), source),
        ["@wp.struct\nclass A:\n    x: int  # [m]\n    y: int", "@wp.func\ndef pack_item(a: int):\n    return a"],
        ['"""\n[ x | y ]"""\n@wp.struct\nclass A:\n    # how far [m]\n    x: int\ndef pack_x(a):\n    pass'],
    ),
    "native functions": (
        rules.native_function_faults,
        [made("        ++x;\n" * 79) for made in (FUNCTION, METHOD)],
        [made("        ++x;\n" * 78) for made in (FUNCTION, METHOD)],
    ),
    "native code in strings": (
        lambda source: rules.snippet_faults(parse(source)),
        ['CODE = """' + "int x = 0;\n" * 16 + '"""'],
        ['CODE = """' + "int x = 0;\n" * 15 + '"""\n"""' + "Prose; more.\n" * 20 + '"""'],
    ),
    "banned words": (
        lambda source: rules.banned_faults(parse(source)),
        ["rung = 1", "def settle_hard_kernel(): pass", "self.wish", "class Mailbox: pass"],
        ["sprung = strung = 1"],
    ),
    "titles": (
        rules.title_faults,
        ['"""Whether two boxes overlap."""', '"""\nWhich pairs meet."""', "x = 1", "// How wide.\n"],
        ['"""Whichever: even-odd ray test.\n\nWhether a point is inside."""', "// Slabs.\n// How wide.\n"],
    ),
    "names of one meaning": (
        lambda source: rules.twice_defined({"a": parse(source), "b": parse("f = 2\nMODULE_OPTIONS = {}")}),
        ["def f():\n    pass", "class f:\n    pass", "f = 1", "e, f = 1, 2", "e, (f, g) = x", "f: int = 1"],
        ["from a import f\n_f = 1\nMODULE_OPTIONS = {}\ndef h():\n    f = 1", "MODULE_OPTIONS = f.x = _f = 1"],
    ),
    "cycles": (
        rules.find_cycle,
        [{"a": {"b"}, "b": {"c"}, "c": {"a"}}, {"a": {"b", "c"}, "b": {"c"}, "c": {"b"}}],
        [{"a": {"b", "c"}, "b": {"c"}, "c": {"numpy"}}],
    ),
    "imports inside functions": (
        lambda source: "warp_abtree.model.tree" in rules.import_edges(ROOT / "warp_abtree" / "names.py", parse(source)),
        ["def f():\n    from warp_abtree.model import tree"],
        ["def f():\n    from numpy import tree"],
    ),
    "groups of kernels": (
        lambda source: rules.group_faults(parse(source), "search"),
        [
            "from warp_abtree.kernels.intersect.face_pairs import Hits",
            "from warp_abtree.kernels import contacts",
            "def f():\n    from warp_abtree.kernels.io.results import pack_pair_kernel",
        ],
        ["from warp_abtree.kernels.base.poses import x"],
    ),
}


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_catches_its_breaks(rule):
    find_faults, broken, fine = RULES[rule]
    assert [source for source in broken if not find_faults(source)] == []
    assert [source for source in fine if find_faults(source)] == []
