"""Texts and pictures of values for consoles and notebooks."""

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.checks import described

THUMBNAIL = 160
"""Longest side of a thumbnail in pixels."""
LEAST_WIDTH = 240
"""Width in pixels up to which small pictures are enlarged."""


def counted(num: int, noun: str) -> str:
    """Return a number with its noun, as in "1 view" and "8,412 points"."""
    return f"{num:,} {noun}{'' if num == 1 else 's'}"


def first_names(names: Sequence[str], most: int = 5) -> str:
    """Return the first few of some names, and an ellipsis if there are more."""
    return ", ".join([*names[:most], *["…"] * (len(names) > most)])


def in_bytes(num: float) -> str:
    """Return a number of bytes with three digits in a unit that suits it: bytes, kB, MB or GB (10^9 bytes)."""
    size, told = float(num), counted(round(num), "byte")
    for unit in ("kB", "MB", "GB"):
        if size < 999.5:
            break
        size /= 1e3
        told = f"{size:,.{2 if size < 9.995 else 1 if size < 99.95 else 0}f} {unit}"
    return told


def short_tuple_repr(value: Any) -> str:
    """Return the `repr` of a named tuple, with arrays by dtype and shape."""
    fields = ", ".join(f"{name}={described(field)}" for name, field in zip(value._fields, value, strict=True))
    return f"{type(value).__name__}({fields})"


def as_bytes(image: Any) -> np.ndarray | None:
    """Return an image of numbers in [0, 1], clipped, as uint8 [H, W, 3]; None if it has no concrete image's shape."""
    try:
        pixels = np.asarray(image)
    except Exception:  # A tracer, a deleted buffer, or what a transformation puts in an array's place.
        return None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape or not np.issubdtype(pixels.dtype, np.floating):
        return None
    rounded: np.ndarray = np.rint(255 * np.clip(np.nan_to_num(pixels), 0, 1)).astype(np.uint8)
    return rounded


def enlarged(pixels: np.ndarray) -> np.ndarray:
    """Return a picture [H, W, C] whose pixels are repeated k × k times, the least k that makes it 240 pixels wide."""
    factor = -(-LEAST_WIDTH // pixels.shape[1])
    return pixels.repeat(factor, axis=0).repeat(factor, axis=1)


def png(pixels: np.ndarray, longest: int | None = None) -> bytes:
    """Return the PNG file of pixels [H, W, 3 or 4] uint8, with no side longer than `longest`."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if longest is not None:
        picture.thumbnail((longest, longest))
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def html_image(file: bytes, title: str) -> str:
    """Return an HTML image of the bytes of a PNG file."""
    text = html.escape(title, quote=True)
    return f'<img src="data:image/png;base64,{base64.b64encode(file).decode()}" title="{text}" alt="{text}">'


def html_table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return an HTML table of names and values."""
    body = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)
    return f"<table><caption>{html.escape(title)}</caption>{body}</table>"
