"""Run the command line: ``warp-abtree`` or ``python -m warp_abtree``.

What needs no Warp stands here: the version, and an interrupt while the library is being imported.
"""

import sys


def main() -> int:
    """Run the command line of this process and return its exit status."""
    from warp_abtree.checks.version import __version__

    if sys.argv[1:] == ["--version"]:
        print(f"warp-abtree {__version__}")
        return 0
    try:
        from warp_abtree.app.cli.main import main as run
    except KeyboardInterrupt:
        print("warp-abtree: interrupted", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
