"""Rules of the floor plan: each lists the breaks of one rule in a parsed source. Sources are read, not run."""

import ast
import re
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Each package may import itself, `checks`, kernels, and what stands in its row.
CORE = ["checks", "model", "state", "query", "scene", "lod", "simulate"]
MAY_IMPORT = {name: set(CORE[:place]) for place, name in enumerate(CORE)}
MAY_IMPORT |= {"interop": set(CORE), "jobs": set(CORE), "app": {*CORE, "interop", "jobs"}}
# A group of kernels may import itself, those before it, and what loads native code.
KERNEL_GROUPS = (
    *("base", "exact", "triangle", "search", "intersect", "update", "build", "distance", "contacts", "motion"),
    *("inside", "lod", "bodies", "robot", "io"),
)
CORE_DEPENDENCIES = {"warp", "numpy", "trimesh", "warp_abtree"}
# What users, benchmarks among them, may import beside public names.
OPEN = {"checks", "testing"}
PUBLIC_MAX, FOLDER_FILES, ARGUMENTS = 34, 12, 10
FILE_LINES, FUNCTION_LINES, SNIPPET_LINES, NATIVE_LINES, NATIVE_FUNCTION_LINES = 400, 60, 15, 200, 80
# A function of a header or a member of its structs, as clang-format lays them out: to the brace at its own indent.
NATIVE_FUNCTION = re.compile(
    r"^( {0,8})(?!struct |namespace |#|//|\})\S[^\n;{}]*\((?:[^;{}]|\{\})*?\)(?: const)?(?:\n? *: [^\n{]*)? \{\n"
    r"(?:(?!\1\}).*\n)*\1\}",
    re.M,
)
WARP_PRIVATE = {"_cls"}  # what tells a struct from other objects
# Names of the old house and words made at home; the field's stand in their place (a word or a part of snake_case).
BANNED = """asker carriers cover_piece crossing_faces dial hungry judge_budget judge_step left_open lodladder mailbox
    patience peer peers rivals rub_point bounce_pair rung rungs send_home settle_hard settle_faces turned_in unsure
    within_tenth wish""".split()

# A title names its file's subject; the first words of riddles do not.
RIDDLES = re.compile(r"(How|Until|What|Whatever|When|Where|Whether|Which|Who|Whose)\b")
# Names that every module of a kind has: options of kernels, commands of the command line.
SHARED_NAMES = {"MODULE_OPTIONS", "EXAMPLES", "OUTPUTS", "SUMMARY", "add_arguments", "main"}

PACKAGE = sorted(path for name in MAY_IMPORT for path in (ROOT / "warp_abtree" / name).rglob("*.py"))
KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
NATIVE = sorted(path for path in (ROOT / "kernels").rglob("*") if path.suffix in (".h", ".cuh", ".cpp", ".cu"))
USERS = sorted(path for folder in ("bench", "scenes") for path in (ROOT / folder).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
FILES = [*PACKAGE, *KERNELS, *USERS, *TESTS]


@cache
def parse(source):
    """Return the syntax tree of a file or a text, which nobody changes."""
    return ast.parse(source.read_text(encoding="utf-8") if isinstance(source, Path) else source)


@cache
def walk(tree):
    return list(ast.walk(tree))


def imports(tree, package):
    """Yield every imported (module, name, line); name is None for `import module`, relative imports made absolute."""
    for node in walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, None, node.lineno
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                yield module, alias.name, node.lineno


def package_of(path):
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


def hidden_import_faults(tree):
    """List imports by a string of what is the project's own, and tests that import tests."""
    faults = []
    for node in walk(tree):
        called = getattr(node, "func", None)
        if getattr(called, "attr", getattr(called, "id", None)) in ("import_module", "__import__"):
            if node.args and "warp_abtree" in ast.unparse(node.args[0]):
                faults.append(f"line {node.lineno}: {ast.unparse(node)}")
    for module, _, line in imports(tree, "x"):
        if module.split(".")[-1].startswith("test_"):
            faults.append(f"line {line}: imports {module}")
        if module.split(".")[0] == "kernels":
            faults.append(f"line {line}: import warp_abtree.kernels, or every kernel exists twice")
    return faults


def private_faults(tree):
    """List private names of other modules and other objects; a class may use those of its own instances."""
    own = {
        node.name if isinstance(node, ast.FunctionDef) else node.attr
        for node in walk(tree)
        if isinstance(node, ast.FunctionDef)
        or (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    }
    faults = []
    for node in walk(tree):
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr):
            of = ast.unparse(node.value)
            if of not in ("self", "cls", "super()", "os", "np") and node.attr not in own | WARP_PRIVATE:
                faults.append(f"line {node.lineno}: {of}.{node.attr} is private")
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp_abtree"):
            names = [alias.name for alias in node.names if re.match("_[a-z]", alias.name)]
            faults += [f"line {node.lineno}: {name} of {node.module} is private" for name in names]
    return faults


def import_edges(path, tree=None):
    """Return the modules of warp_abtree that a module imports, inside functions too."""
    return {
        found
        for module, name, _ in imports(tree or parse(path), package_of(path))
        if module.split(".")[0] == "warp_abtree"
        for found in [f"{module}.{name}", module]
    }


def find_cycle(edges):
    """Return modules that import one another in a circle, [] where there is none."""
    try:
        TopologicalSorter({module: found - {module} for module, found in edges.items()}).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def documented():
    """Return the dotted names of the API reference."""
    pages = (path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").rglob("*.md")))
    return {name for page in pages for name in re.findall(r"^::: ([\w.]+)$", page, re.M)}


def outside_faults(tree, public, package, known=frozenset()):
    """List what a user of the library takes from it beyond its public names and the modules of the API reference."""
    public, faults, aliases = {*public, *OPEN}, [], set()
    for node in walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname or "warp_abtree" for alias in node.names if alias.name == "warp_abtree"}
    for module, name, line in imports(tree, package):
        parts = module.split(".")
        if parts[0] != "warp_abtree" or (len(parts) > 1 and parts[1] in OPEN) or {module, f"{module}.{name}"} & known:
            continue
        if len(parts) > 1 or (name is not None and name not in public):
            faults.append(f"line {line}: {module}{'.' + name if name else ''} is not public")
    for node in walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            if node.attr not in public:
                faults.append(f"line {node.lineno}: warp_abtree.{node.attr} is not public")
    return faults


def kernel_import_faults(tree):
    """List imports of a kernel file that leave kernels/, or are relative."""
    faults = []
    for node in walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            faults.append(f"line {node.lineno}: relative import")
    for module, name, line in imports(tree, "warp_abtree.kernels"):
        inside = module.startswith("warp_abtree.kernels") or (module == "warp_abtree" and name == "kernels")
        root = module.split(".")[0]
        if not inside and root not in {"warp", "numpy"} and root not in sys.stdlib_module_names:
            faults.append(f"line {line}: imports {module}")
    return faults


def group_of(path):
    """Return the group of a kernel file, None for what stands beside the groups."""
    parts = path.relative_to(ROOT / "kernels").parts
    return parts[0] if len(parts) > 1 else None


def group_faults(tree, group):
    """List imports of a kernel file from groups above its own."""
    place = KERNEL_GROUPS.index(group) if group else -1
    faults = []
    for module, name, line in imports(tree, "warp_abtree.kernels"):
        found = [*module.split("."), name][2:3] if module.startswith("warp_abtree.kernels") else []
        if {*found} & {*KERNEL_GROUPS[place + 1 :]}:
            faults.append(f"line {line}: {group} imports {found[0]}")
    return faults


def is_kernel(function):
    decorators = [node.func if isinstance(node, ast.Call) else node for node in function.decorator_list]
    return any(ast.unparse(node) in ("wp.kernel", "warp.kernel", "kernel") for node in decorators)


def kernel_faults(tree):
    """List kernels that are misnamed, or whose outputs do not come last."""
    faults = []
    for node in walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        if is_kernel(node) != node.name.endswith("_kernel"):
            faults.append(f"{node.name}: kernels, and only kernels, are named *_kernel")
        if not is_kernel(node):
            continue
        names = [argument.arg for argument in node.args.args]
        group = [2 if name.endswith("_out") else 1 if name.endswith("_inout") else 0 for name in names]
        if group != sorted(group):
            faults.append(f"{node.name}: arguments {names} are not in the order inputs, _inout, _out")
    return faults


def size_faults(tree, text):
    """List functions that are too long or take too many arguments beside those by name, and a file that is too long."""
    count = len(text.splitlines())
    faults = [f"{count} lines"] if count > FILE_LINES else []
    for node in walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        lines = node.end_lineno - node.body[0].lineno + 1  # its signature apart
        if lines > FUNCTION_LINES:
            faults.append(f"{node.name}: {lines} lines")
        names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
        taken = [name for name in names if name not in ("self", "cls")]
        if len(taken) > ARGUMENTS:
            faults.append(f"{node.name}: {len(taken)} arguments")
    return faults


def struct_faults(tree, text):
    """List fields of kernel structs without a comment beside or above them, and packed words without a diagram."""
    faults, lines = [], text.splitlines()
    for node in walk(tree):
        if isinstance(node, ast.ClassDef) and any("struct" in ast.unparse(mark) for mark in node.decorator_list):
            for field in node.body:
                if isinstance(field, ast.AnnAssign):
                    above = lines[field.lineno - 2].strip()
                    if "#" not in lines[field.lineno - 1] and not above.startswith("#"):
                        faults.append(f"line {field.lineno}: {node.name}.{field.target.id} has no comment")
        if isinstance(node, ast.FunctionDef) and node.name.startswith("pack_"):
            if not re.search(r"^ *\[.*\|.*\]", text, re.M):
                faults.append(f"{node.name}: no bit diagram in its file")
    return faults


def snippet_faults(tree):
    """List strings that hold more native code than a few lines."""
    faults = []
    for node in walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            code = [line for line in node.value.splitlines() if re.search(r"[;{}]\s*(//.*|\\)?$", line)]
            if len(code) > SNIPPET_LINES:
                faults.append(f"line {node.lineno}: {len(code)} lines of native code")
    return faults


def native_function_faults(text):
    """List the native functions that are too long."""
    found = [(match[0].count("\n") + 1, match[0].strip().partition("(")[0]) for match in NATIVE_FUNCTION.finditer(text)]
    return [f"{name}: {lines} lines" for lines, name in found if lines > NATIVE_FUNCTION_LINES]


def banned_faults(tree):
    """List identifiers that hold a word of the old house."""
    names = {node.id for node in walk(tree) if isinstance(node, ast.Name)}
    names |= {node.attr for node in walk(tree) if isinstance(node, ast.Attribute)}
    names |= {node.arg for node in walk(tree) if isinstance(node, ast.arg)}
    names |= {node.name for node in walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    banned = re.compile(rf"(^|_)({'|'.join(BANNED)})(_|$)")
    return sorted(name for name in names if banned.search(name.lower()))


def title_faults(source):
    """List the title of a module or native file that asks in the place of naming the subject, or the lack of one."""
    if source.lstrip().startswith("//"):
        title = source.lstrip().partition("\n")[0].lstrip("/ ")
    else:
        title = (ast.get_docstring(parse(source)) or "").partition("\n")[0]
    return [f"line 1: {title}"] if not title or RIDDLES.match(title) else []


def top_level_names(tree):
    """Return the names that a module defines at its top level, but for private ones."""
    names = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = [part for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
            names |= {part.id for part in parts if isinstance(part.ctx, ast.Store)}
    return {name for name in names if not name.startswith("_")}


def twice_defined(trees):
    """Return the names that several modules define, each with its modules; one name has one meaning."""
    modules = {}
    for module, tree in trees.items():
        for name in top_level_names(tree) - SHARED_NAMES:
            modules.setdefault(name, []).append(module)
    return {name: found for name, found in modules.items() if len(found) > 1}


def public_names():
    for node in parse(ROOT / "warp_abtree" / "names.py").body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []
