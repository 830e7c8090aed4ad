"""The package: its version, and names that are imported when first asked for, so that a process pays for what it uses.

Nothing of Warp is imported here.
"""

import ast
import functools
import gc
import importlib
import importlib.util
import threading

__version__ = "0.2.0"

_lock, _imports, _collects = threading.Lock(), 0, False


@functools.cache
def find_modules(source: str) -> dict:
    """Return the module that each name comes from which a module imports by `from`; none is imported for that."""
    spec = importlib.util.find_spec(source)
    get_source = getattr(spec.loader, "get_source", None) if spec else None
    text = get_source(source) if get_source else None
    imports = [node for node in ast.parse(text or "").body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: node.module for node in imports for alias in node.names}


def import_quickly(module: str):
    """Import a module without the collections of garbage that so many new objects set off: a fifth of the time."""
    global _imports, _collects
    with _lock:
        _imports += 1
        if _imports == 1:
            _collects = gc.isenabled()
            gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        with _lock:  # the last of several threads
            _imports -= 1
            if _imports == 0 and _collects:
                gc.enable()
