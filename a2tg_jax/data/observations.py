"""Points of a reconstruction in the photographs that saw them."""

from typing import Any, NamedTuple

import numpy as np


class SeenPoints(NamedTuple):
    """Points that a reconstruction saw in a photograph: in each pixel the nearest, in the order of pixels.

    In a batch the arrays are [V, S], filled up with depths of 0 in pixels from H·W.
    """

    pixels: Any
    """[S] int32, the pixels' indices row·W + column."""
    depths: Any
    """[S] float32 depths along the camera's z axis, above 0, in units of the normalised world."""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return int(self.pixels.nbytes + self.depths.nbytes)


def seen_points(places: np.ndarray, depths: np.ndarray, size: tuple[int, int]) -> SeenPoints:
    """Return the points that lie within a picture and before its camera.

    Args:
      places: [S, 2] x and y in pixels, the centre of the first at 0.5; NaN where there is none.
      depths: [S] along the camera's z axis.
      size: (H, W).
    """
    is_within = ((places >= 0) & (places < size[::-1])).all(axis=1)  # False for NaN.
    is_within &= (depths > 0) & np.isfinite(depths)
    column, row = places[is_within].astype(np.int32).T
    pixels, near = row * np.int32(size[1]) + column, depths[is_within].astype(np.float32)
    order = np.lexsort((near, pixels))
    found, first = np.unique(pixels[order], return_index=True)
    return SeenPoints(found, near[order][first])


def check_seen_points(points: SeenPoints, size: tuple[int, int], what: str) -> None:
    """Raise ValueError, naming it `what`, unless points are as `seen_points` makes them for a picture (H, W)."""
    pixels, depths = (np.asarray(x) for x in points)
    end = size[0] * size[1]
    has_arrays = pixels.shape == depths.shape and pixels.ndim == 1
    if not has_arrays or pixels.dtype != np.int32 or depths.dtype != np.float32:
        raise ValueError(
            f"{what} must be pixels [S] int32 and depths [S] float32; got {pixels.dtype} {list(pixels.shape)} and "
            f"{depths.dtype} {list(depths.shape)}: make them with seen_points"
        )
    if len(pixels) and (pixels[0] < 0 or pixels[-1] >= end or (np.diff(pixels) <= 0).any()):
        raise ValueError(f"{what} must have increasing pixels from 0 to {end - 1}: make them with seen_points")
    if not ((depths > 0) & np.isfinite(depths)).all():
        raise ValueError(f"{what} must have finite depths above 0: make them with seen_points")


def stacked_points(points: list[SeenPoints | None], size: tuple[int, int], length: int) -> SeenPoints:
    """Return the points of V views of a size (H, W) as arrays [V, length], filled up as `SeenPoints` says."""
    pixels = np.tile(np.arange(length, dtype=np.int32) + np.int32(size[0] * size[1]), (len(points), 1))
    depths = np.zeros(pixels.shape, np.float32)
    for row, own in enumerate(points):
        if own is not None:
            pixels[row, : len(own.pixels)], depths[row, : len(own.depths)] = own
    return SeenPoints(pixels, depths)
