"""Tables of results on a page of the documentation, between marks that name them.

<!-- results/small/claim.md -->
…
<!-- end -->
"""

import re
from pathlib import Path

from a2tg_jax.host.atomic import replacing

BLOCK = re.compile(r"(<!-- (results/\S+\.md) -->\n).*?(<!-- end -->)", re.DOTALL)


def refresh(page: Path, experiments: Path) -> list[str]:
    """Puts the tables that a page names where it names them; returns their names."""
    text = page.read_text(encoding="utf-8")
    with replacing(page) as temporary:
        temporary.write_text(with_tables(text, experiments), encoding="utf-8")
    return names(text)


def with_tables(text: str, experiments: Path) -> str:
    """The page with the tables as they are now."""
    return BLOCK.sub(lambda found: f"{found[1]}\n{body(experiments / found[2])}\n{found[3]}", text)


def names(text: str) -> list[str]:
    """The files that a page shows."""
    return [found[2] for found in BLOCK.finditer(text)]


def body(path: Path) -> str:
    """A page of results without its title, its headings one level lower."""
    _, *lines = path.read_text(encoding="utf-8").strip().splitlines()
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in lines).strip() + "\n"
