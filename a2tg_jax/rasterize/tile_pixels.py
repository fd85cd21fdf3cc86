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

from a2tg_jax.core.cameras import Camera

PRIOR = 1e-6
"""Weight of the unit matrix, per pixel, where a tile's pixels do not tell its frame: a single row or column of them."""


class Spans(NamedTuple):
    """Coordinates along an axis that the tiles of each column, or row, cover."""

    reached: Array
    """Largest coordinate of the tiles so far; ascending."""
    begun: Array
    """Smallest coordinate of the tiles from here on; ascending."""


class TilePixels(NamedTuple):
    """Pixels of every tile. Coordinates without a frame are pixels of the image plane of K."""

    centers: Array
    """[T, 2] mean place of a tile's rays."""
    frames: Array
    """[T, 2, 2] matrices from the image plane to the tile's frame, in pixels of the image."""
    offsets: Array
    """[T, 2, P] places of the pixels from the centre, in the tile's frame; 0 without a ray."""
    is_seen: Array
    """[T, P] whether a pixel lies in the image and has a ray."""
    boxes: Array
    """[T, 4] left, top, right and bottom edge of the tile's rays; an empty box without any."""
    magnifications: Array
    """[T] bound of the length in the image plane of one pixel of the image."""


def pixels_of(camera: Camera, tile_size: int) -> TilePixels | None:
    """Return the pixels of all tiles of a camera with rays; None for a pinhole camera."""
    return None if camera.rays is None else tile_pixels(camera.rays, tile_size)


def tile_pixels(rays: Array, tile_size: int, num_rows: int | None = None) -> TilePixels:
    """Return the pixels of all tiles.

    Args:
      rays: [H, W, 2] places of the pixels' rays in the image plane; not finite where a pixel has none.
      tile_size: side of a tile.
      num_rows: number of rows of tiles; pixels below the image have no ray. None: those of the image.
    """
    height, width = rays.shape[:2]
    num_rows, num_columns = -(-height // tile_size) if num_rows is None else num_rows, -(-width // tile_size)
    margins = (0, num_rows * tile_size - height), (0, num_columns * tile_size - width), (0, 0)
    padded = jnp.pad(jax.lax.stop_gradient(rays), margins, constant_values=jnp.nan)
    blocks = padded.reshape(num_rows, tile_size, num_columns, tile_size, 2).transpose(0, 2, 4, 1, 3)
    places = blocks.reshape(num_rows * num_columns, 2, tile_size**2)
    is_seen = jnp.all(jnp.isfinite(places), axis=1)
    boxes = _boxes(places, is_seen)
    centers, jacobians = _fitted(places, is_seen, tile_size)
    frames = jnp.linalg.inv(jacobians)
    offsets = jnp.where(is_seen[:, None], places - centers[:, :, None], 0.0)
    return TilePixels(
        centers=centers,
        frames=frames,
        offsets=jnp.einsum("tij,tjp->tip", frames, offsets, precision="highest"),
        is_seen=is_seen,
        boxes=boxes,
        # The Frobenius norm bounds the length of the image of a unit vector.
        magnifications=jnp.sqrt(jnp.sum(jacobians**2, axis=(1, 2))),
    )


def band_pixels(pixels: TilePixels, first: Array, num: int, num_shown: Array) -> TilePixels:
    """Return the pixels of so many tiles in a row, from tile `first` on, of which the last ones may not be shown."""
    band: TilePixels = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, num), pixels)
    is_shown = (jnp.arange(num, dtype=jnp.int32) < num_shown)[:, None]
    nowhere = jnp.asarray([[jnp.inf, jnp.inf, -jnp.inf, -jnp.inf]], band.boxes.dtype)
    return band._replace(is_seen=band.is_seen & is_shown, boxes=jnp.where(is_shown, band.boxes, nowhere))


def _boxes(places: Array, is_seen: Array) -> Array:
    """Return the boxes [T, 4] around the rays of each tile."""
    low = jnp.min(jnp.where(is_seen[:, None], places, jnp.inf), axis=2)
    high = jnp.max(jnp.where(is_seen[:, None], places, -jnp.inf), axis=2)
    return jnp.concatenate([low, high], axis=1)


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
    (_, pixels), (centers, places) = about_mean(pixels), about_mean(places)
    prior = PRIOR * num[:, None, None] * jnp.eye(2, dtype=places.dtype)[None]
    covariance, spread = (
        jnp.einsum("tip,tjp->tij", own, pixels, precision="highest") + prior for own in (places, pixels)
    )
    return centers, covariance @ jnp.linalg.inv(spread)


def spans_of(pixels: TilePixels, num_columns: int, reach: Array) -> tuple[Spans, Spans]:
    """Return the spans of the columns and of the rows, so many pixels of the image wider at each side.

    Args:
      pixels: of all tiles.
      num_columns: number C of columns.
      reach: pixels.
    """
    margins = (reach * pixels.magnifications)[:, None]
    low, high = pixels.boxes[:, :2] - margins, pixels.boxes[:, 2:] + margins
    low, high = (edge.reshape(-1, num_columns, 2) for edge in (low, high))
    spans = []
    for axis in range(2):  # Over the rows for the columns, over the columns for the rows.
        # Lenses bend rows and columns, so that spans overlap and need not be in order. The largest end so far and the
        # least begin from here on are, and contain them: `covered` can search them by halves.
        begun, reached = jnp.min(low[..., axis], axis=axis), jnp.max(high[..., axis], axis=axis)
        spans.append(Spans(jax.lax.cummax(reached), jax.lax.cummin(begun, reverse=True)))
    return spans[0], spans[1]


def covered(spans: Spans, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the first of the columns, or rows, that [low, high] may reach [N], and their number."""
    first = jnp.searchsorted(spans.reached, low, side="left").astype(jnp.int32)
    end = jnp.searchsorted(spans.begun, high, side="right").astype(jnp.int32)
    is_covered = (low <= high) & (first < end)
    return jnp.where(is_covered, first, 0), jnp.where(is_covered, end - first, 0)
