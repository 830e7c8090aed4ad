"""python release/release_notes.py VERSION: print the section of CHANGELOG.md about a version, as Markdown."""

import re
import sys
from pathlib import Path

CHANGELOG = Path(__file__).resolve().parents[1] / "CHANGELOG.md"


def notes_of(version: str, text: str) -> str:
    """Return what stands under the heading of a version, `## 1.2.3` with or without a date; raise ValueError if none.

    Lines of a paragraph are joined, since forges break lines where a text does.
    """
    parts = re.split(r"^## +\[?([^\]\s]+)\]?.*\n", text, flags=re.M)[1:]
    sections = dict(zip(parts[::2], parts[1::2]))
    if not sections.get(version, "").strip():
        known = ", ".join(name for name, section in sections.items() if section.strip())
        raise ValueError(f"CHANGELOG.md has nothing about {version}; it has {known}")
    return re.sub(r"(?<=\S)\n +(?=[^\s*-])", " ", sections[version].strip()) + "\n"


if __name__ == "__main__":
    try:
        print(notes_of(sys.argv[1], CHANGELOG.read_text(encoding="utf-8")), end="")
    except ValueError as error:
        sys.exit(str(error))
