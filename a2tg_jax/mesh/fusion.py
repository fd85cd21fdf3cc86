"""Fusion of depth maps into sparse voxels: truncated signed distances, their mean over the views, and colours.

The distance is that from the surface's plane, by the normal of the render. A view counts where it faces the surface and
its depths are sure: its weight falls with the spread of a depth.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.mesh.blocks import LOCAL, SIDE, VOXELS, BlockGrid, unique_blocks
from a2tg_jax.mesh.depth_maps import RenderedDepth
from a2tg_jax.mesh.space import TRUNCATION, Space
from a2tg_jax.training.losses import back_project

SURE = 0.5
"""Spread of a depth, in truncations, that halves its weight."""
NOWHERE = -(2**31)
"""Coordinate of blocks of pixels without a depth."""
CHUNK = 64
"""Blocks that are fused at a time: few, so that they stay in the cache."""
OFFSETS = np.linspace(-TRUNCATION, TRUNCATION, 5).tolist()
"""Places along a ray around its depth, in voxels, whose blocks exist."""

Voxels = tuple[Array, Array, Array, Array]
"""Distances, weights, colours and colour weights of some blocks."""


def fuse(grid: BlockGrid, depths: RenderedDepth, space: Space) -> None:
    """Fuse one view into the blocks around its depths.

    Raises:
      GridFullError: if the grid's memory budget has no room for the blocks.
    """
    rows = grid.allocate(blocks_near(depths, space))
    arrays: tuple[np.ndarray, ...] = grid.distance, grid.weight, grid.color, grid.color_weight
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        padded = np.concatenate([chosen, np.repeat(chosen[:1], CHUNK - len(chosen))])
        before = tuple(jnp.asarray(array[padded]) for array in arrays)
        fused = _jitted_fuse()(before, jnp.asarray(grid.coordinates[padded]), depths, space)
        for array, values in zip(arrays, fused, strict=True):
            array[chosen] = np.asarray(values)[: len(chosen)]


def blocks_near(depths: RenderedDepth, space: Space) -> np.ndarray:
    """Return the blocks [B, 3] within a truncation of the depths, along their rays."""
    return unique_blocks(np.asarray(_jitted_near()(depths, space)))


@functools.cache
def _jitted_near() -> jax.stages.Wrapped:
    return jax.jit(_near)


def _near(depths: RenderedDepth, space: Space) -> Array:
    """Return blocks [P, 3] around the depths, with repetitions; NOWHERE where there is no depth."""
    points = back_project(depths.depth, depths.camera).reshape(-1, 3)
    rays = points - depths.camera.center[None]
    rays = rays / jnp.maximum(jnp.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    reach = (space.voxel * space.scale(points))[:, None]
    is_valid = (depths.depth.reshape(-1) > 0) & space.contains(points)
    blocks = [jnp.floor(space.indices(points + offset * reach * rays) / SIDE) for offset in OFFSETS]
    named = [jnp.where(is_valid[:, None], block.astype(jnp.int32), NOWHERE) for block in blocks]
    return jnp.concatenate(named)


@functools.cache
def _jitted_fuse() -> jax.stages.Wrapped:
    return jax.jit(_fused)


def _fused(voxels: Voxels, blocks: Array, depths: RenderedDepth, space: Space) -> Voxels:
    """Return the voxels of blocks [B, 3] after one more view."""
    distance, weight, color, color_weight = voxels
    points = space.positions((blocks[:, None] * SIDE + LOCAL[None]).reshape(-1, 3))
    truncation = TRUNCATION * space.voxel * space.scale(points)
    x, y, z = pixels_and_depths(points, depths.camera)
    seen, is_seen = _depths_at(depths.depth, x, y, truncation)
    pixel = _pixels(x, y, *depths.depth.shape)
    spread, slant, facing = (image.reshape(-1)[pixel] for image in (depths.spread, depths.slant, depths.facing))
    signed = slant * (seen - z) / truncation
    behind = jnp.clip((1 + signed) / (1 - 1 / TRUNCATION), 0.0, 1.0)
    sure = facing**2 * behind / (1 + (spread / (SURE * truncation)) ** 2)
    own = jnp.where(is_seen & (z > 0) & (signed >= -1), sure, 0.0).reshape(-1, VOXELS)
    near = jnp.where(signed.reshape(-1, VOXELS) < 1, own, 0.0)
    color_weight = color_weight + near
    share = near / jnp.maximum(color_weight, 1e-12)
    return (
        distance + own * jnp.minimum(signed, 1.0).reshape(-1, VOXELS),
        weight + own,
        _mixed(color, share, depths.color, pixel),
        color_weight,
    )


def _mixed(color: Array, share: Array, image: Array, pixel: Array) -> Array:
    """Return colours [B, VOXELS, 3] moved by a share [B, VOXELS] towards those of pixels."""
    mean = color.astype(jnp.float32)
    shown = [image[..., channel].reshape(-1)[pixel].reshape(share.shape) for channel in range(3)]
    mixed = [mean[..., channel] + share * (shown[channel] - mean[..., channel]) for channel in range(3)]
    return jnp.stack(mixed, -1).astype(jnp.float16)


def pixels_and_depths(points: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return pixel coordinates x and y, and the depth z, of points [P, 3]; x and y are far out behind the camera."""
    # Written out: XLA is tens of times slower at products of many rows with a 3 × 3 matrix.
    across, down, z = (_affine(camera.viewmat[row, :3], points, camera.viewmat[row, 3]) for row in range(3))
    is_ahead = z > 0
    depth = jnp.where(is_ahead, z, 1.0)
    x, y = ((K[0] * across + K[1] * down) / depth + K[2] for K in (camera.K[0], camera.K[1]))
    return jnp.where(is_ahead, x, -1e6), jnp.where(is_ahead, y, -1e6), z


def _affine(row: Array, points: Array, offset: Array) -> Array:
    return row[0] * points[:, 0] + row[1] * points[:, 1] + row[2] * points[:, 2] + offset


def _depths_at(depth: Array, x: Array, y: Array, truncation: Array) -> tuple[Array, Array]:
    """Return the depth at points [P] of an image, and whether there is one.

    Inverse depths of a plane are linear in the image: they are interpolated where four pixels have depths that differ
    by less than the truncation. Elsewhere the nearest pixel counts.
    """
    height, width = depth.shape
    flat = depth.reshape(-1)
    left, top = jnp.floor(x - 0.5), jnp.floor(y - 0.5)
    right, below = x - 0.5 - left, y - 0.5 - top
    a, b, c, d = (flat[_pixels(left + dx, top + dy, height, width)] for dy in (0.5, 1.5) for dx in (0.5, 1.5))
    nearest = jnp.where(below < 0.5, jnp.where(right < 0.5, a, b), jnp.where(right < 0.5, c, d))
    least = jnp.minimum(jnp.minimum(a, b), jnp.minimum(c, d))
    most = jnp.maximum(jnp.maximum(a, b), jnp.maximum(c, d))
    upper = (1 - right) / jnp.maximum(a, 1e-12) + right / jnp.maximum(b, 1e-12)
    lower = (1 - right) / jnp.maximum(c, 1e-12) + right / jnp.maximum(d, 1e-12)
    is_smooth = (least > 0) & (most - least < truncation)
    is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    between = 1 / ((1 - below) * upper + below * lower)
    return jnp.where(is_smooth, between, nearest), is_inside & (nearest > 0)


def _pixels(x: Array, y: Array, height: int, width: int) -> Array:
    """Return the indices [P] of the pixels at points, or of the nearest at the border."""
    column = jnp.clip(jnp.floor(x), 0, width - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, height - 1).astype(jnp.int32)
    return row * width + column
