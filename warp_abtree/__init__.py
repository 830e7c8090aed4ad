"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from typing import TYPE_CHECKING

from warp_abtree.checks.package import __version__ as __version__

if TYPE_CHECKING:
    from warp_abtree.names import *  # noqa: F403
else:
    from warp_abtree.checks import package as _package

    def __getattr__(name):
        """Import what one of `warp_abtree.names` stands for, and Warp with it, when it is first asked for."""
        if name == "__all__" or not name.startswith("_"):
            source = "warp_abtree.names"
            module = _package.import_quickly(_package.find_modules(source).get(name, source))
            if hasattr(module, name):
                globals()[name] = getattr(module, name)
            if name in globals():  # packages, too
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return [*globals(), *__getattr__("__all__")]
