"""python docs/demos.py SITE: record the scenes of demos.md as pages into the folder demos of a built site."""

import sys
from pathlib import Path

from warp_abtree.app.cli.main import main

LARGEST = 6_000_000  # bytes of a page
DEMOS = {"bunny_tori": (), "focus": ("--objects", "300"), "nut_and_bolt": ("--objects", "5")}


def record(folder: Path) -> int:
    """Record all scenes into a folder; return 0, or the first exit status that is not."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, words in DEMOS.items():
        path = folder / f"{name}.html"
        status = main(["run", name, *words, "--device", "cpu", "--json", "--record", str(path)])
        if status or path.stat().st_size > LARGEST:
            print(f"{path}: status {status}, or more than {LARGEST:,} bytes", file=sys.stderr)
            return status or 1
    return 0


if __name__ == "__main__":
    sys.exit(record(Path(sys.argv[1]) / "demos"))
