"""Hooks of the site: files outside docs/ that pages link to become pages."""

import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
# [text](../scenes/planning.py), with or without a section of the page.
LINK = re.compile(r"\]\((\.\./[\w./-]+)(#[\w-]+)?\)")
LANGUAGES = {".py": "python", ".toml": "toml"}


def target_of(page: str, link: str) -> str | None:
    """Return the path, from the repository's root, that a page of docs/ links to; None if that lies in docs/."""
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), link))
    return None if path.startswith("docs/") else path


def page_of(path: str) -> str:
    """Return the page that shows a file of the repository."""
    return f"source/{path}.md"


def on_files(files, config):
    """Add a page for each file that the pages link to."""
    linked = {
        target_of(page.src_uri, match[1])
        for page in files.documentation_pages()
        for match in LINK.finditer(Path(page.abs_src_path).read_text(encoding="utf-8"))
    }
    for path in sorted(linked - {None}):
        text = (ROOT / path).read_text(encoding="utf-8")
        if not path.endswith(".md"):
            title = path.rsplit("/", 1)[-1]
            text = f"# {title}\n\n`{path}`\n\n````{LANGUAGES[Path(path).suffix]}\n{text}````\n"
        files.append(File.generated(config, page_of(path), content=text, inclusion=InclusionLevel.NOT_IN_NAV))
    return files


def on_page_markdown(markdown, page, config, files):
    """Point links to such files at their pages."""
    if page.file.generated_by:
        return markdown

    def to_page(match):
        path = target_of(page.file.src_uri, match[1])
        if path is None:
            return match[0]
        link = posixpath.relpath(page_of(path), posixpath.dirname(page.file.src_uri) or ".")
        return f"]({link}{match[2] or ''})"

    return LINK.sub(to_page, markdown)
