"""Hooks of mkdocs: pages of the site that are no files of docs/, and links from docs/ to the rest of the repository."""

import html
import json
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\((?!\w+:|#)([^)\s#]+)((?:#[^)\s]*)?)\)")
"""Links to files: the path, relative to the page, and the heading."""
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md"}
NOTEBOOK = "notebooks/any.ipynb"
"""Page that stands for every notebook: all lie in one folder."""
FILES = "repository"
"""Folder of the site with the files that pages link to."""


def on_files(files: "Files", config: Any) -> "Files":
    """Add the pages at the top of the repository, the notebooks, and the files that pages link to."""
    from mkdocs.structure.files import File

    texts = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    texts |= {name: (ROOT / name).read_text(encoding="utf-8") for name in PAGES}
    for name, place in PAGES.items():
        files.append(File.generated(config, place, content=with_places(texts[name], name)))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text = notebook_text(json.loads(path.read_text(encoding="utf-8")))
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
    for name in sorted({target(match[1], page) for page, text in texts.items() for match in LINK.finditer(text)}):
        place = place_of(name)
        if place.startswith(f"{FILES}/"):
            files.append(File.generated(config, place, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead the links out of docs/ to where their files lie in the site."""
    return with_places(markdown, f"docs/{page.file.src_uri}") if page.file.abs_src_path else markdown


def with_places(text: str, page: str) -> str:
    """Return a page of the repository with its links as they are in the site."""
    folder = posixpath.dirname(place_of(page)) or "."

    def link(match: re.Match[str]) -> str:
        return f"]({posixpath.relpath(place_of(target(match[1], page)), folder)}{match[2]})"

    return LINK.sub(link, text)


def target(link: str, page: str) -> str:
    """Return the path in the repository that a link of a page leads to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def place_of(name: str) -> str:
    """Return where a file of the repository lies in the site."""
    if name in PAGES:
        return PAGES[name]
    if name == "notebooks":
        return "notebooks.md"
    if name.endswith(".ipynb"):
        return f"{name.removesuffix('.ipynb')}.md"
    if name.startswith("docs/"):
        return name.removeprefix("docs/")
    # As text, other Markdown is a file of the site and not a page of it.
    return f"{FILES}/{name}.txt" if name.endswith(".md") else f"{FILES}/{name}"


def notebook_text(notebook: dict[str, Any]) -> str:
    """Return a notebook as Markdown: text, code, and what the code printed and showed."""
    return "\n\n".join(part for cell in notebook["cells"] for part in _cell_parts(cell))


def _cell_parts(cell: dict[str, Any]) -> list[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        return [with_places(source, NOTEBOOK)]
    alt = cell["metadata"].get("alt", "")
    shown = (_shown(output, alt) for output in cell["outputs"])
    return [f"```python\n{source}\n```", *(part for part in shown if part)]


def _shown(output: dict[str, Any], alt: str) -> str:
    """Return one output of a cell: a picture, which `alt` describes, a table, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    if "text/html" in data:
        return "".join(data["text/html"])
    text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
    return f"```text\n{text}\n```" if text else ""
