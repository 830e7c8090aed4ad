"""Run the command line: ``python -m warp_abtree``."""

import sys

from warp_abtree.app.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
