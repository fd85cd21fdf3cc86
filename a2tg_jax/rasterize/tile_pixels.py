"""Pixels of a camera with a ray for each pixel, such as a fisheye, in frames of its tiles.

`Camera.rays` places each pixel's ray in the image plane of the pinhole camera K, where splats are projected. Each tile
has an affine frame: the affine map from that plane to the tile's pixels that fits best. In its frame, pixels lie about
where they do in the image. So the low-pass filter is as wide as for a pinhole camera, and float32 is as exact. Every
pixel keeps its own ray: only the filter is approximated.

T tiles of P pixels, in C columns.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

PRIOR = 1e-6
"""Weight of the unit matrix, per pixel, where a tile's pixels do not determine its frame: one row or column of them."""


class TilePixels(NamedTuple):
    """Pixels of every tile. Coordinates without a frame are pixels of the image plane of K."""

    centers: Array  # [T, 2] mean place of a tile's rays
    frames: Array  # [T, 2, 2] matrices from the image plane to the tile's frame, in pixels of the image
    offsets: Array  # [T, 2, P] places of the pixels from the centre, in the tile's frame; 0 without a ray
    is_seen: Array  # [T, P] whether a pixel lies in the image and has a ray
    boxes: Array  # [T, 4] left, top, right and bottom edge of the tile's rays; an empty box without any
    magnifications: Array  # [T] bound of the length in the image plane of one pixel of the image


def tile_pixels(rays: Array, tile_size: int) -> TilePixels:
    """Return the pixels of all tiles, given the places [H, W, 2] of their rays in the image plane, which are not finite
    where a pixel has none."""
    height, width = rays.shape[:2]
    num_rows = -(-height // tile_size)
    num_columns = -(-width // tile_size)
    margins = (0, num_rows * tile_size - height), (0, num_columns * tile_size - width), (0, 0)
    padded = jnp.pad(jax.lax.stop_gradient(rays), margins, constant_values=jnp.nan)
    blocks = padded.reshape(num_rows, tile_size, num_columns, tile_size, 2).transpose(0, 2, 4, 1, 3)
    places = blocks.reshape(num_rows * num_columns, 2, tile_size**2)
    is_seen = jnp.all(jnp.isfinite(places), axis=1)
    low = jnp.min(jnp.where(is_seen[:, None], places, jnp.inf), axis=2)
    high = jnp.max(jnp.where(is_seen[:, None], places, -jnp.inf), axis=2)
    centers, jacobians = _fitted(places, is_seen, tile_size)
    frames = jnp.linalg.inv(jacobians)
    offsets = jnp.where(is_seen[:, None], places - centers[:, :, None], 0.0)
    return TilePixels(
        centers=centers,
        frames=frames,
        offsets=jnp.einsum("tij,tjp->tip", frames, offsets, precision="highest"),
        is_seen=is_seen,
        boxes=jnp.concatenate([low, high], axis=1),
        # The Frobenius norm bounds the length of the image of a unit vector.
        magnifications=jnp.sqrt(jnp.sum(jacobians**2, axis=(1, 2))),
    )


def _fitted(places: Array, is_seen: Array, tile_size: int) -> tuple[Array, Array]:
    """Return the mean places [T, 2], and the matrices [T, 2, 2] from pixels of the image to the image plane that fit
    best."""
    y, x = np.mgrid[:tile_size, :tile_size] - (tile_size - 1) / 2
    weights = is_seen.astype(places.dtype)
    pixels = jnp.broadcast_to(jnp.asarray(np.stack([x.ravel(), y.ravel()]), places.dtype), places.shape)
    num = jnp.maximum(jnp.sum(weights, axis=1), 1.0)

    def about_mean(values: Array) -> tuple[Array, Array]:
        values = jnp.where(is_seen[:, None], values, 0.0)
        mean = jnp.sum(values, axis=2) / num[:, None]
        return mean, (values - mean[:, :, None]) * weights[:, None]

    # Least squares, place ≈ centre + J·pixel: J = Σ place·pixelᵀ (Σ pixel·pixelᵀ)⁻¹, both about their means. The prior
    # adds a multiple of the unit matrix to both sums, which leads to J = 1 where pixels do not determine it.
    _, pixels = about_mean(pixels)
    centers, places = about_mean(places)
    prior = PRIOR * num[:, None, None] * jnp.eye(2, dtype=places.dtype)[None]
    covariance = jnp.einsum("tip,tjp->tij", places, pixels, precision="highest") + prior
    spread = jnp.einsum("tip,tjp->tij", pixels, pixels, precision="highest") + prior
    return centers, covariance @ jnp.linalg.inv(spread)


def covered_tiles(
    pixels: TilePixels, num_columns: int, reach: Array, low: tuple[Array, Array], high: tuple[Array, Array]
) -> tuple[tuple[Array, Array], ...]:
    """Return the first column that the boxes low..high may reach [N], and their number; and likewise the rows.

    Tiles are `reach` pixels of the image wider at each side.
    """
    margins = (reach * pixels.magnifications)[:, None]
    edges = pixels.boxes[:, :2] - margins, pixels.boxes[:, 2:] + margins
    begins, ends = (edge.reshape(-1, num_columns, 2) for edge in edges)
    spans = []
    for axis in range(2):  # Over the rows for the columns, over the columns for the rows.
        # Lenses bend rows and columns, so that their spans overlap and may be out of order. The largest end so far and
        # the least begin from here on are in order, for a binary search, and contain the spans.
        begun = jnp.min(begins[..., axis], axis=axis)
        reached = jnp.max(ends[..., axis], axis=axis)
        begun = jax.lax.cummin(begun, reverse=True)
        reached = jax.lax.cummax(reached)
        first = jnp.searchsorted(reached, low[axis], side="left").astype(jnp.int32)
        end = jnp.searchsorted(begun, high[axis], side="right").astype(jnp.int32)
        is_covered = (low[axis] <= high[axis]) & (first < end)
        spans.append((jnp.where(is_covered, first, 0), jnp.where(is_covered, end - first, 0)))
    return tuple(spans)
