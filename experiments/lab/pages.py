"""Tables of results within pages of text, between marks that name their files.

<!-- results/small/fixed_memory.md -->
…
<!-- end -->
"""

import re
from pathlib import Path

from a2tg_jax.base.atomic import replacing

EXPERIMENTS = Path(__file__).resolve().parents[1]
PAGES = (EXPERIMENTS.parent / "docs" / "results.md", EXPERIMENTS / "NOTEBOOK.md")
TITLE = re.compile(r"^# .*\n+", re.MULTILINE)
BLOCK = re.compile(r"(<!-- (results/\S+\.md) -->\n).*?(<!-- end -->)", re.DOTALL)


def refresh() -> None:
    """Write the current tables into the pages."""
    for page in PAGES:
        text = with_tables(page.read_text(encoding="utf-8"), EXPERIMENTS)
        with replacing(page) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(page, flush=True)


def with_tables(text: str, experiments: Path) -> str:
    """Return a page with the current tables."""
    return BLOCK.sub(lambda found: f"{found[1]}\n{body(experiments / found[2])}\n{found[3]}", text)


def names(text: str) -> list[str]:
    """Return the files whose tables a page shows."""
    return [found[2] for found in BLOCK.finditer(text)]


def body(path: Path) -> str:
    """Return a page of results without its title, if it has one, its headings one level lower."""
    text = TITLE.sub("", path.read_text(encoding="utf-8"), count=1)
    return re.sub(r"^#", "##", text, flags=re.MULTILINE).strip() + "\n"
