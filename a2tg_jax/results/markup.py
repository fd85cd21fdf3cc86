"""HTML of self-contained pages: nothing is loaded, and only the page's own style and script apply."""

import base64
import hashlib
from collections.abc import Collection, Iterable, Sequence
from html import escape


def page(title: str, body: str, *, style: str, script: str) -> str:
    """Return a whole document.

    Args:
      title: as plain text.
      body: HTML.
      style, script: the only ones that a browser will take, by their hashes; so no text of a scene can become one.
    """
    policy = f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {_source(script)}"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title>\n<style>{style}</style></head>\n"
        f"<body>\n{body}\n<script>{script}</script></body></html>\n"
    )


def _source(text: str) -> str:
    """Return the name of an inline style or script in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], best: Collection[tuple[int, int]] = ()) -> str:
    """Return a table of plain texts.

    Args:
      titles: of the columns.
      rows: of as many cells.
      best: (row, column) of the cells that are marked.
    """
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    body = ""
    for at, row in enumerate(rows):
        cells = (_cell(text, (at, column) in best) for column, text in enumerate(row))
        body += f"<tr>{''.join(cells)}</tr>"
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str, is_best: bool) -> str:
    return f'<td class="best">{escape(text)}</td>' if is_best else f"<td>{escape(text)}</td>"


def image(uri: str, caption: str, kind: str = "") -> str:
    """Return a picture with a plain-text caption.

    Args:
      uri: data: with the picture.
      caption: below it, and in its place for those who do not see it.
      kind: a class of the style.
    """
    text = escape(caption)
    return f'<figure class="{kind}"><img src="{uri}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def layers(uris: Sequence[str], captions: Sequence[str], kind: str = "") -> str:
    """Return pictures of one size in layers; without a script, they stand side by side."""
    pairs = zip(uris, captions, strict=True)
    return f'<div class="layers {kind}">{"".join(image(uri, caption) for uri, caption in pairs)}</div>'


def slider(body: str, captions: Sequence[str]) -> str:
    """Return `layers` with a slider below that draws each picture over the one before; the last is shown at first."""
    last = len(captions) - 1
    label = escape(f"from {captions[0]} to {captions[-1]}")
    stops = "".join(
        f'<button type="button" value="{at}">{escape(caption)}</button>' for at, caption in enumerate(captions)
    )
    controls = f'<input type="range" min="0" max="{last}" value="{last}" step="any" aria-label="{label}">'
    controls += f'<div class="stops">{stops}</div>'
    return f'<div class="compare"><div class="pictures">{body}</div><div class="controls">{controls}</div></div>'
