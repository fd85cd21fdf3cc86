"""Pictures and tables of values in notebooks."""

import base64
import html
import io
from collections.abc import Iterable

import numpy as np

THUMBNAIL = 160
"""Longest side of a thumbnail in pixels."""
LEAST_WIDTH = 240
"""Width in pixels up to which small pictures are enlarged."""


def as_bytes(image: object) -> np.ndarray | None:
    """Return an image of numbers in [0, 1], clipped, as uint8 [H, W, 3]; None if it has no concrete image's shape."""
    try:
        pixels = np.asarray(image)
    except Exception:  # A tracer, a deleted buffer, or what a transformation puts in an array's place.
        return None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape or not np.issubdtype(pixels.dtype, np.floating):
        return None
    # NaN has no byte, and is shown as 0.
    return np.rint(255 * np.clip(np.nan_to_num(pixels), 0, 1)).astype(np.uint8)


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
