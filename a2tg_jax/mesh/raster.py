"""Triangles drawn into pixels: which face each pixel shows, and where on it (host)."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.mesh.triangles import Mesh

CANDIDATES = 1 << 20
"""Pixels that are tested at a time."""
NEAR = 1e-3
"""Smallest depth of a corner of a face that is drawn, in units of the median depth."""


class Raster(NamedTuple):
    """Faces and places of pixels."""

    face: np.ndarray
    """[H, W] int32 face of each pixel; -1 without one."""
    weights: np.ndarray
    """[H, W, 3] float32 barycentric coordinates there."""
    depth: np.ndarray
    """[H, W] float32 depth there; infinite without a face."""


def draw(points: np.ndarray, depths: np.ndarray, width: int, height: int, margin: float = 0.0) -> Raster:
    """Draw triangles; the nearest one shows.

    Args:
      points: [F, 3, 2] corners in pixels; those of faces that are not drawn are NaN.
      depths: [F, 3] depths of the corners, positive.
      width, height: of the picture in pixels.
      margin: smallest barycentric coordinate that still counts as inside is -margin.
    """
    face = np.full(width * height, -1, np.int32)
    nearest = np.full(width * height, np.inf, np.float32)
    weights = np.zeros((width * height, 3), np.float32)
    for faces, pixels in _candidates(points, width, height):
        at = np.stack([pixels % width, pixels // width], -1) + np.float32(0.5)
        own = _barycentric(points[faces], at)
        depth = 1 / np.sum(own / depths[faces], axis=1)
        shows = np.flatnonzero((own >= -margin).all(axis=1) & (depth < nearest[pixels]))
        shows = shows[np.argsort(-depth[shows], kind="stable")]  # The nearest is written last.
        chosen = pixels[shows]
        face[chosen], nearest[chosen], weights[chosen] = faces[shows], depth[shows], own[shows]
    corrected = weights / np.where(face[:, None] >= 0, depths[face], 1.0)
    corrected /= np.maximum(corrected.sum(axis=1, keepdims=True), 1e-30)
    shape = height, width
    return Raster(face.reshape(shape), corrected.reshape(*shape, 3).astype(np.float32), nearest.reshape(shape))


def draw_view(mesh: Mesh, camera: Camera) -> Raster:
    """Draw a mesh as a camera sees it; faces that reach behind the camera are left out."""
    viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
    at = mesh.vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = at[:, 2]
    least = NEAR * np.median(z[z > 0]) if (z > 0).any() else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.where(z[:, None] > least, (at / z[:, None]) @ K[:2].T, np.nan)
    return draw(pixels[mesh.faces].astype(np.float32), z[mesh.faces].astype(np.float32), camera.width, camera.height)


def _candidates(points: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return (faces, pixels) [P] of the pixels within the bounds of each face, some at a time."""
    with np.errstate(invalid="ignore"):
        low = np.maximum(np.ceil(points.min(axis=1) - 0.5), 0)
        high = np.minimum(np.floor(points.max(axis=1) - 0.5), (width - 1, height - 1))
        is_drawn = (high >= low).all(axis=1)
    order = np.flatnonzero(is_drawn)
    low, span = low[order].astype(np.int64), (high[order] - low[order] + 1).astype(np.int64)
    ends = np.cumsum(span.prod(axis=1))
    start = 0
    while start < len(order):
        done = ends[start - 1] if start else 0
        end = max(start + 1, int(np.searchsorted(ends, done + CANDIDATES, side="right")))
        sizes = span[start:end].prod(axis=1)
        rows = np.repeat(np.arange(start, end), sizes)
        index = np.arange(len(rows)) - np.repeat(ends[start:end] - sizes - done, sizes)
        x, y = low[rows, 0] + index % span[rows, 0], low[rows, 1] + index // span[rows, 0]
        yield order[rows], y * width + x
        start = end


def _barycentric(corners: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates [P, 3] of points [P, 2] in triangles [P, 3, 2]; NaN in those without an area."""
    a, b, c = corners.transpose(1, 0, 2)
    along, across, own = b - a, c - a, at - a
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = (own[:, 0] * across[:, 1] - own[:, 1] * across[:, 0]) / area
        third = (along[:, 0] * own[:, 1] - along[:, 1] * own[:, 0]) / area
        return np.stack([1 - second - third, second, third], -1)
