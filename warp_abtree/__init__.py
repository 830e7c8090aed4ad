"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from typing import TYPE_CHECKING

from warp_abtree.checks.version import __version__ as __version__

if TYPE_CHECKING:
    from warp_abtree.names import *  # noqa: F403
else:

    def __getattr__(name):
        """Import Warp and the library when the first of `warp_abtree.names` is asked for."""
        if name == "__all__" or not name.startswith("_"):
            import warp_abtree.names as public

            globals().update({known: getattr(public, known) for known in ("__all__", *public.__all__)})
            if name in globals():
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return [*globals(), *__getattr__("__all__")]
