"""Pages of the documentation that show tables of results, between marks that name their files.

<!-- results/small/claim.md -->
…
<!-- end -->
"""

import re
from pathlib import Path

from a2tg_jax.host.atomic import replacing

EXPERIMENTS = Path(__file__).resolve().parents[1]
DOCS = EXPERIMENTS.parent / "docs"
PAGE, APPENDIX = DOCS / "results.md", DOCS / "results-appendix.md"
TEXT = EXPERIMENTS / "appendix.md"
"""Text of the appendix, without its tables."""
TITLE = re.compile(r"^# .*\n+", re.MULTILINE)
BLOCK = re.compile(r"(<!-- (results/\S+\.md) -->\n).*?(<!-- end -->)", re.DOTALL)


def pages(experiments: Path = EXPERIMENTS) -> dict[Path, str]:
    """Return the pages with the committed tables, by path."""
    sources = {PAGE: PAGE, APPENDIX: TEXT}
    return {page: with_tables(source.read_text(encoding="utf-8"), experiments) for page, source in sources.items()}


def refresh(experiments: Path = EXPERIMENTS) -> None:
    """Write the pages."""
    for page, text in pages(experiments).items():
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
