"""Detection of panoramas of 360° × 180° among pictures twice as wide as high, by their pixels.

In such a panorama the right edge continues at the left one, and each pole is one point, which the first or the last row
shows all along. Plain edges join as well, and so do the edges of vignettes and of mirrored pictures. So the edges must
have texture, differ as little as neighbouring columns do, and differ more the farther from the seam they are compared.
"""

from typing import Literal

import numpy as np
from PIL import Image

Projection = Literal["panorama", "fisheyes", "photograph", "unclear"]
"""Kinds of pictures twice as wide as high; "fisheyes" are two round ones side by side, "unclear" ones have no texture
at their edges."""
WIDTH = 512
"""Width to which wider pictures are averaged down."""
EDGE = 24
"""Width of the picture over half the width of the strips at both edges that are compared."""
LEAST_TEXTURE = 2.5
LEAST_GROWTH = 1.5
"""Smallest difference in grey levels of columns at half a strip's width in a row with texture, and its smallest ratio
to the difference of neighbouring columns, which noise has as well."""
LEAST_ROWS = 0.04
"""Smallest share of rows with texture."""
MOST_STEP = 0.36
"""Largest step over the seam, as a share of the difference of the strips farther from it, both above the difference of
neighbouring columns: up to 0.22 in panoramas, from 0.45 on in other pictures."""
UNRELATED = 0.4
"""Step over the seam, in units of the difference at half a strip's width, from which on the edges do not join."""
MIRRORED = 0.4
SLIGHTLY = 0.05
"""Smallest difference of the strips farther from the seam, in the same unit, if they are smooth, and if they have
detail. Mirrored strips and vignettes have about 0."""
LEAST_DETAIL = 4.0
"""Mean distance in grey levels from a parabola along each row from which on strips have detail."""
LEAST_ALONG = 0.06
"""Smallest variation along the outermost columns, in the same unit; frames have none."""
BLOCKS = 32
MOST_AT_POLES = 0.5
POLE_NOISE = 2.0
"""Largest variation along the first and the last row, as a share of the one along other rows, and grey levels above
that."""
OUTSIDE = 0.57
RING = (0.33, 0.42)
"""Distances from the middle of each half, in units of the height: beyond any fisheye's circle, and within its rim."""
DARK = 32.0
LIT = 12.0
LEAST_LIT = 6
"""Brightest grey level beyond the circles of fisheyes, how much brighter half of an eighth of a rim is, and the least
number of such eighths; a letterbox has 4."""


def projection_of(pixels: np.ndarray) -> Projection:
    """Return what a picture [H, W, C] uint8 is, which is twice as wide as high."""
    colors = pixels[..., :3]
    if pixels.shape[1] > WIDTH:
        colors = np.asarray(Image.fromarray(colors).resize((WIDTH, WIDTH // 2), Image.Resampling.BOX))
    colors = colors.astype(np.float32)
    if _shows_fisheyes(colors.mean(axis=2)):
        return "fisheyes"
    blocks = np.stack([block.mean(axis=1) for block in np.array_split(colors, BLOCKS, axis=1)], axis=1)
    along_rows = np.abs(np.diff(blocks, axis=1, append=blocks[:, :1])).mean(axis=(1, 2))
    if max(along_rows[0], along_rows[-1]) > MOST_AT_POLES * np.quantile(along_rows, 0.75) + POLE_NOISE:
        return "photograph"
    return _projection_by_seam(colors)


def _shows_fisheyes(grey: np.ndarray) -> bool:
    """Return whether two bright circles on black are side by side in a picture [H, W] of grey levels."""
    height = len(grey)
    y, x = np.mgrid[0:height, 0:height] + 0.5 - height / 2
    radius = np.hypot(x, y) / height
    eighth = (4 * (np.arctan2(y, x) / np.pi + 1)).astype(int) % 8
    halves = grey[:, :height], grey[:, height:]
    black = np.quantile([half[radius > OUTSIDE] for half in halves], 0.9)
    is_rim = (radius > RING[0]) & (radius < RING[1])
    if black > DARK:
        return False
    for half in halves:
        rims = np.array([np.median(half[is_rim & (eighth == number)]) for number in range(8)])
        if (rims > black + LIT).sum() < LEAST_LIT:
            return False
    return True


def _projection_by_seam(colors: np.ndarray) -> Projection:
    """Return whether the right edge of colours [H, W, 3] continues at the left one."""
    height, width = colors.shape[:2]
    reach = max(3, width // EDGE)
    left = colors[:, : 2 * reach + 2]
    right = colors[:, -2 * reach - 2 :]

    def difference(distance: int) -> np.ndarray:
        """Return the mean difference [H] of columns of one strip that are this far apart."""
        steps = [np.abs(strip[:, distance:] - strip[:, :-distance]).mean(axis=(1, 2)) for strip in (left, right)]
        return np.mean(steps, axis=0)

    near = difference(1)
    far = difference(reach + 1)
    has_texture = (far >= LEAST_TEXTURE) & (far >= LEAST_GROWTH * near)
    has_texture[: height // 12] = False  # Everything is smooth near the poles.
    has_texture[height - height // 12 :] = False
    if has_texture.sum() < max(4, LEAST_ROWS * height):
        return "unclear"
    left = left[has_texture]
    right = right[has_texture]
    base = near[has_texture].mean()
    unit = (far - near)[has_texture].mean()
    # Column k from the seam to the right, and to the left: 2k + 1 columns apart in a panorama.
    across = (np.abs(left - right[:, ::-1]).mean(axis=(0, 2)) - base) / unit
    step = across[0]
    farther = across[reach // 4 : 3 * reach // 4 + 1].mean()
    if step >= UNRELATED:
        return "photograph"
    parabolas = np.linalg.qr(np.vander(np.linspace(-1, 1, left.shape[1]), 3))[0]
    rest = [np.abs(strip - np.einsum("hwc,wk,xk->hxc", strip, parabolas, parabolas)).mean() for strip in (left, right)]
    is_mirrored = farther < (SLIGHTLY if np.mean(rest) >= LEAST_DETAIL else MIRRORED)
    outermost = np.stack([left[:, 0], right[:, -1]])
    along = np.abs(outermost - np.median(outermost, axis=1, keepdims=True)).mean() / unit
    joins = step <= MOST_STEP * farther and not is_mirrored and along >= LEAST_ALONG
    return "panorama" if joins else "unclear"
