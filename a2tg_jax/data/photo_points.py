"""Points where photographs agree, from which scenes without points start.

A point of a surface has the same colour in all photographs that show it; a point in the air has the colours of whatever
is behind it (voxel colouring, Seitz and Dyer 1997; space carving, Kutulakos and Seitz 2000). Of random candidates,
those where photographs are transparent are dropped, and in each cell of each photograph the one of the most similar
colours is kept. Then points near those are tried, in four rounds (as in PatchMatch, Barnes et al. 2009).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from a2tg_jax import Mask, Picture, RenderSettings
from a2tg_jax.core.cameras import pinhole_pixels

# Chosen in experiments/NOTEBOOK.md, "A start from photographs".
MOST_VIEWS = 32
"""Number of photographs that are compared."""
SIDE = 100
"""Longer side, in pixels, of the photographs that are compared; larger ones are averaged down to about this."""
CELLS = 64
"""Cells along the longer side of a photograph."""
FEW_VIEWS = 2.0
"""A point that n photographs show has this / n added to its difference: few agree by chance, and points close to a
camera hide much."""
SHARE = 0.4
"""Quantile of a point's differences by which it is judged: larger ones may be of photographs in which it is hidden."""
LEAST_DETAIL = 0.06
"""Least range of a colour channel around a cell's pixel in an opaque photograph: before a plain background, photographs
agree anywhere in the air."""
MOST_PLAIN = 0.5
"""Largest plain share of the photographs. Beyond it, points hang before a background that they match from most sides,
and training keeps them: chair on opaque white loses 6 dB by them."""
LEAST = 1e-6
"""Lower bound of what is divided by."""
TRANSPARENT = 0.02
"""Opacity below which a pixel shows nothing of the object."""
MOST_SPOILT = 0.05
"""Share of the photographs, or a single one, that may be transparent before a point: some are cut out badly."""
BEST = 0.1
"""Quantile of the differences of points by which poses are judged: with right ones it is 0.67 to 0.82 times as large as
for photographs exchanged among the cameras, with wrong ones 0.99 to 1.1 times. The median differs less."""
ROUNDS = 4
"""Rounds in which points near the kept ones are tried, half as many as at first."""


class Look:
    """A photograph of a pinhole camera at about `SIDE` pixels, to look points up in."""

    def __init__(self, picture: Picture, mask: Mask | None, viewmat: np.ndarray, K: np.ndarray):
        """Args:
        picture: the photograph, which is read.
        mask: which of its pixels count; None: all.
        viewmat: [4, 4] world to camera.
        K: [3, 3] in pixels of the picture.
        """
        pixels = picture.read()
        self.viewmat = viewmat
        self.K = K
        self.size = pixels.shape[:2]
        factor = max(1, round(max(self.size) / SIDE))
        step = max(1, factor // 4)  # Some of many pixels are enough for a mean.
        self.factor = factor // step * step
        pixels = pixels[::step, ::step].astype(np.float32) / 255
        counts = np.ones_like(pixels[..., :1])
        if mask is not None:
            counts = mask.read()[::step, ::step, None].astype(np.float32)
        opacity = pixels[..., 3:] if pixels.shape[2] == 4 else np.ones_like(counts)
        columns = [counts, counts * opacity, counts * opacity * pixels[..., :3]]
        means = _averaged(np.concatenate(columns, axis=2), self.factor // step)
        self.counts = means[..., 0]
        self.opacity = means[..., 1] / np.maximum(self.counts, LEAST)
        self.colors = means[..., 2:] / np.maximum(means[..., 1:2], LEAST)
        ranges = maximum_filter(self.colors, (3, 3, 1)) - minimum_filter(self.colors, (3, 3, 1))
        is_opaque = bool(((self.opacity >= 1 - TRANSPARENT) | (self.counts <= 0.5)).all())
        self.is_plain = (ranges.max(axis=2) < LEAST_DETAIL) & is_opaque

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return colours [P, 3] of points, NaN where they are not shown, their cells [P], -1 there and where the
        photograph is plain, and whether they are before a transparent pixel [P]."""
        in_frame = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = pinhole_pixels(in_frame, self.K).T
        height, width = self.size
        is_in = (in_frame[:, 2] > RenderSettings.near_plane) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        column = np.where(is_in, x, 0).astype(int)
        row = np.where(is_in, y, 0).astype(int)
        pixel = row // self.factor, column // self.factor
        is_in &= self.counts[pixel] > 0.5
        is_free = is_in & (self.opacity[pixel] < TRANSPARENT)
        is_in &= ~is_free
        side = max(self.size) / CELLS
        cells = np.where(
            is_in & ~self.is_plain[pixel], (row // side).astype(int) * CELLS + (column // side).astype(int), -1
        )
        return np.where(is_in[:, None], self.colors[pixel], np.nan), cells, is_free


def agreeing_points(looks: Sequence[Look], candidates: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [P, 3], P ≤ `most`, at which photographs agree, and their colours [P, 3] in [0, 1].

    They are among the candidates [C, 3], or near those. The same arguments give the same points; no photographs, or
    plain ones (`plain_share`), give none.
    """
    if not looks or plain_share(looks) > MOST_PLAIN:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    kept = _best(_compared(looks, candidates))
    for _ in range(ROUNDS if len(kept.points) > 1 else 0):
        # As far from the kept points as these are from each other.
        distances = cKDTree(kept.points).query(kept.points, k=2)[0][:, 1]
        around = rng.integers(len(kept.points), size=len(candidates) // 2)
        moved = kept.points[around] + distances[around, None] * rng.normal(size=(len(around), 3))
        kept = _best(kept.followed_by(_compared(looks, moved)))
    chosen = slice(None) if len(kept.points) <= most else rng.choice(len(kept.points), most, replace=False)
    return kept.points[chosen], kept.colors[chosen]


def plain_share(looks: Sequence[Look]) -> float:
    """Return the share of the photographs that has no detail to compare."""
    return float(np.mean([look.is_plain.mean() for look in looks]))


def agreement(looks: Sequence[Look], points: np.ndarray) -> float:
    """Return how much the colours of the best points [P, 3] differ among photographs, of which three or more show each;
    infinite if there are none. Wrong poses give larger numbers."""
    compared = _compared(looks, points)
    best = _best(compared.at(np.flatnonzero(compared.num_seen >= 3)))
    return float(np.quantile(best.differences, BEST)) if len(best.points) else np.inf


class _Compared(NamedTuple):
    """Candidates that a photograph shows, and before which others are not transparent."""

    points: np.ndarray
    colors: np.ndarray  # [P, 3], the mean of the photographs that agree.
    differences: np.ndarray  # [P].
    num_seen: np.ndarray  # [P], photographs that show a point.
    cells: np.ndarray  # [P, V], the cell of each photograph, -1 where it shows nothing or is plain.

    def at(self, rows: np.ndarray) -> "_Compared":
        return _Compared(*(column[rows] for column in self))

    def followed_by(self, other: "_Compared") -> "_Compared":
        return _Compared(*map(np.concatenate, zip(self, other, strict=True)))


def _compared(looks: Sequence[Look], points: np.ndarray) -> _Compared:
    """Compare the colours of points [C, 3] in the photographs."""
    seen = [look.at(points) for look in looks]
    colors, cells, is_free = map(np.stack, zip(*seen, strict=True))
    num_seen = (~np.isnan(colors[..., 0])).sum(axis=0)
    kept = (is_free.sum(axis=0) <= max(1, MOST_SPOILT * len(looks))) & (num_seen > 0)
    points = points[kept]
    colors = colors[:, kept]
    cells = cells[:, kept]
    num_seen = num_seen[kept]
    # Unseen colours are NaN, which is sorted to the end.
    middle = _at_share(colors, 0.5, num_seen)
    distances = np.abs(colors - middle).sum(axis=2)
    agrees = distances <= _at_share(distances, 0.5, num_seen)
    mean = np.where(agrees[..., None], colors, 0).sum(axis=0) / agrees.sum(axis=0)[:, None]
    differences = _at_share(np.abs(colors - mean).sum(axis=2), SHARE, num_seen)
    return _Compared(points, mean, differences, num_seen, cells.T)


def _best(candidates: _Compared) -> _Compared:
    """Return the candidate of the most similar colours in each cell of each photograph."""
    order = np.argsort(candidates.differences + FEW_VIEWS / candidates.num_seen, kind="stable")
    is_best = np.zeros(len(order), bool)
    for cells in candidates.cells[order].T:
        cell, first = np.unique(cells, return_index=True)
        is_best[order[first[cell >= 0]]] = True
    return candidates.at(np.flatnonzero(is_best))


def _at_share(values: np.ndarray, share: float, counts: np.ndarray) -> np.ndarray:
    """Return the quantile of values [V, P, …] over the first axis, of the `counts` [P] ≥ 1 that are not NaN."""
    place = np.floor(share * (counts - 1)).astype(int).reshape(1, -1, *[1] * (values.ndim - 2))
    return np.take_along_axis(np.sort(values, axis=0), place, axis=0)[0]


def _averaged(image: np.ndarray, factor: int) -> np.ndarray:
    """Return an image [H, W, C] averaged over squares of `factor` pixels; those at its end may be smaller."""
    for axis in (0, 1):
        starts = np.arange(0, image.shape[axis], factor)
        sizes = np.diff(np.append(starts, image.shape[axis]))
        image = np.add.reduceat(image, starts, axis=axis) / np.expand_dims(sizes, (1 - axis, 2))
    return image.astype(np.float32)
