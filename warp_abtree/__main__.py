"""Run the command line: ``warp-abtree`` or ``python -m warp_abtree``.

What needs no Warp stands here: the version, and signals while the library is being imported and after the command.
"""

import atexit
import os
import signal
import sys


def main() -> int:
    """Run the command line of this process and return its exit status."""
    from warp_abtree.checks.package import __version__
    from warp_abtree.checks.signals import handle_signals

    handle_signals(end_process, end_process)
    atexit.register(handle_signals, signal.SIG_IGN, signal.SIG_IGN)  # the last to be called: what is left is short
    if sys.argv[1:] == ["--version"]:
        print(f"warp-abtree {__version__}")
        return 0
    from warp_abtree.app.cli.main import main as run

    try:
        return run()
    finally:
        handle_signals(end_process, end_process)


def end_process(number, frame):
    """Handle SIGINT and SIGTERM by the end of the process: modules that are being imported may catch any exception."""
    told = "interrupted" if number == signal.SIGINT else "terminated"
    os.write(2, f"warp-abtree: {told}\n".encode())
    os._exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
