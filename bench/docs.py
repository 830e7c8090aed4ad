"""python -m bench.docs PAGE ...: write the tables of pages of docs/ again, from the JSON of the runs that they show.

Between `<!-- table: RUN/TABLE -->` and `<!-- /table -->` stands a table of the run in DATA/RUN.json, where there is
none yet a line that says so; likewise `<!-- claims: RUN -->` and `<!-- run: RUN -->`.
"""

import json
import re
import sys
from pathlib import Path

from .html import SHOWN_RUN, VERDICT, common_run, judge
from .parts import Finished, cells
from .study import STUDIES, find_parts

DATA = Path(__file__).resolve().parents[1] / "docs" / "data"
BLOCK = re.compile(r"<!-- (table|claims|run): (\S+) -->\n.*?<!-- /\1 -->", re.DOTALL)


def read_run(path) -> list:
    """Return the finished parts of a study's JSON; parts that the study no longer has are left out."""
    found = json.loads(Path(path).read_text(encoding="utf-8"))
    names = STUDIES if found["study"] == "all" else (found["study"],)
    parts = [part for name in names for part in find_parts(name)]
    return [
        Finished(part, kept["rows"], kept["run"], kept["notes"])
        for part in parts
        if (kept := found["parts"].get(part.name))
    ]


def render(page: str, data=DATA) -> str:
    """Return a page with its blocks written anew.

    Raises:
        ValueError: A block names a table that no part has.
    """
    runs = {}

    def write(match):
        kind, name = match[1], match[2]
        run, _, table = name.partition("/")
        file = Path(data) / f"{run}.json"
        if run not in runs:
            runs[run] = read_run(file) if file.is_file() else None
        if runs[run] is None:
            body = f"Not run yet: no `{run}.json`."
        elif kind == "table":
            body = markdown_table(runs[run], table)
        else:
            body = markdown_claims(runs[run]) if kind == "claims" else markdown_run(runs[run])
        return f"<!-- {kind}: {name} -->\n{body}\n<!-- /{kind} -->"

    return BLOCK.sub(write, page)


def _grid(headings, body, left) -> str:
    rule = ["---" if is_left else "--:" for is_left in left]
    lines = [[cell.replace("|", "\\|") for cell in line] for line in body]
    return "\n".join("| " + " | ".join(line) + " |" for line in [headings, rule, *lines])


def markdown_table(finished, name) -> str:
    """Return a table as Markdown."""
    for done in finished:
        for table in done.part.tables:
            if table.name == name:
                rows = table.rows(done.rows)
                left = [any(isinstance(row.get(column.name), str) for row in rows) for column in table.columns]
                return _grid([column.heading for column in table.columns], cells(table, done.rows), left)
    if name in {table.name for study in STUDIES for part in find_parts(study) for table in part.tables}:
        return "Not measured in this run."
    raise ValueError(f"no part has a table {name!r}")


def markdown_claims(finished) -> str:
    """Return all claims as Markdown: who says what, whether it held, by how much."""
    body = [
        [claim.text, claim.source, VERDICT[held], finding] for done in finished for claim, held, finding in judge(done)
    ]
    return _grid(["claim", "of", "held?", "found"], body, [True] * 4)


def markdown_run(finished) -> str:
    """Return device, date, versions and command as a Markdown list."""
    facts = common_run(finished)
    lines = [f"- {key}: {f'`{facts[key]}`' if key == 'command' else facts[key]}" for key in SHOWN_RUN if key in facts]
    return "\n".join(lines + ([f"- size: {facts['size']}"] if "size" in facts else []))


def main(argv):
    """Write pages again."""
    for name in argv:
        path = Path(name)
        path.write_text(render(path.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
