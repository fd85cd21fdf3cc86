"""Points of a reconstruction in the photographs that observed them."""

from typing import Any, NamedTuple

import numpy as np

from a2tg_jax.core.cameras import LARGEST_COORDINATE
from a2tg_jax.core.checks import check_kind


class ObservedPoints(NamedTuple):
    """Points that a photograph observed, in the order of their pixels; of several in a pixel, the nearest.

    In a batch the arrays are [V, S], padded with depths of 0 at pixels from H·W.
    """

    pixels: Any
    """[S] int32, the pixels' indices row·W + column."""
    depths: Any
    """[S] float32 depths along the camera's z axis, above 0, in units of the normalised world."""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return int(self.pixels.nbytes + self.depths.nbytes)

    def scaled(self, factor: float) -> "ObservedPoints":
        """Return the points in a world that is `factor` times as large, without those that are then too near or far."""
        depths = (self.depths * np.float64(factor)).astype(np.float32)
        is_usable = _are_usable(depths)
        return ObservedPoints(self.pixels[is_usable], depths[is_usable])


def observed_points(xy: np.ndarray, depths: np.ndarray, size: tuple[int, int]) -> ObservedPoints:
    """Return the points within a picture and in front of its camera.

    Args:
      xy: [S, 2] x and y in pixels, 0.5 at the centre of the first; NaN where there is none.
      depths: [S] along the camera's z axis.
      size: (H, W).

    Returns:
      The points, in the order of their pixels.

    Raises:
      ValueError: if the arrays have other shapes.
    """
    xy, depths = np.asarray(xy, np.float64), np.asarray(depths, np.float64)
    if xy.ndim != 2 or xy.shape != (len(depths), 2) or depths.ndim != 1:
        raise ValueError(f"xy must be [S, 2] and depths [S]; got {list(xy.shape)} and {list(depths.shape)}")
    is_within = ((xy >= 0) & (xy < size[::-1])).all(axis=1) & _are_usable(depths)  # False for NaN.
    column, row = xy[is_within].astype(np.int32).T
    # int32 holds any index: pictures have at most 128 megapixels.
    pixels, near = row * np.int32(size[1]) + column, depths[is_within].astype(np.float32)
    order = np.lexsort((near, pixels))  # By pixel, the nearest first; `unique` returns the index of the first.
    found, first = np.unique(pixels[order], return_index=True)
    return ObservedPoints(found, near[order][first])


def before_camera(points: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """Return the points of [P, 3] in a world that are in front of a camera, in its frame."""
    own: np.ndarray = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return own[own[:, 2] > 0]


def pinhole_pixels(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return x and y [P, 2] in pixels of points [P, 3] in front of a pinhole camera, in its frame."""
    seen = points @ K.T
    return seen[:, :2] / seen[:, 2:]


def _are_usable(depths: np.ndarray) -> np.ndarray:
    """Return [S] whether depths, and their inverses, are within the bounds of coordinates."""
    return (depths >= 1 / LARGEST_COORDINATE) & (depths <= LARGEST_COORDINATE)  # False for NaN.


def check_observed_points(points: ObservedPoints, size: tuple[int, int], what: str) -> None:
    """Raise ValueError, naming it `what`, unless points are as `observed_points` makes them for a picture (H, W)."""
    advice = "make them with observed_points"
    check_kind(what, points, ObservedPoints, advice)
    pixels, depths = (np.asarray(x) for x in points)
    end = size[0] * size[1]
    has_arrays = pixels.shape == depths.shape and pixels.ndim == 1
    if not has_arrays or pixels.dtype != np.int32 or depths.dtype != np.float32:
        raise ValueError(
            f"{what} must be pixels [S] int32 and depths [S] float32; got {pixels.dtype} {list(pixels.shape)} and "
            f"{depths.dtype} {list(depths.shape)}: {advice}"
        )
    if len(pixels) and (pixels[0] < 0 or pixels[-1] >= end or (np.diff(pixels) <= 0).any()):
        raise ValueError(f"{what} must have increasing pixels from 0 to {end - 1}: {advice}")
    if not _are_usable(depths).all():
        raise ValueError(f"{what} must have depths from {1 / LARGEST_COORDINATE:g} to {LARGEST_COORDINATE:g}: {advice}")


def stacked_points(points: list[ObservedPoints | None], size: tuple[int, int], length: int) -> ObservedPoints:
    """Return the points of V views of a size (H, W) as arrays [V, length], padded as `ObservedPoints` says."""
    # Padding continues the order past the image: training.terms.points_loss promises JAX sorted, unique indices.
    pixels = np.tile(np.arange(length, dtype=np.int32) + np.int32(size[0] * size[1]), (len(points), 1))
    depths = np.zeros(pixels.shape, np.float32)
    for row, own in enumerate(points):
        if own is not None:
            pixels[row, : len(own.pixels)], depths[row, : len(own.depths)] = own
    return ObservedPoints(pixels, depths)
