"""Fusion of rendered depths into sparse voxels: truncated signed distances, their mean over the views, and colours.

A render has the sums Σ w·z and Σ w·z² of its splats, so that a depth is a mean with a spread. At an edge, or in a cloud
of splats, the spread is large, and the mean is between surfaces. A view therefore has most weight where it faces the
surface and its depths are certain. Distances are from the surface's plane, by the render's normal.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax import Camera, RenderOutput, back_project, pytree, static
from a2tg_jax.core.numerics import normalize

TRUNCATION = 5.0
"""Truncation of signed distances in voxels."""
SURE = 0.5
"""Spread of a depth, in truncations, that halves its weight."""
OFFSETS = np.linspace(-TRUNCATION, TRUNCATION, 5).tolist()
"""Offsets from a depth along its ray, in voxels, at which blocks are made."""
FARTHEST = 1e3
"""Largest distance from the centre in an unbounded space, in radii."""
LEAST_FACING = 0.1
"""Smallest cosine between a ray and a normal; smaller ones are raised to it."""
LEAST_ALPHA = 0.5
"""Smallest alpha of a pixel that has a depth."""
EMPTY_ALPHA = 0.1
"""Alpha of a pixel below which nothing is on its ray."""
NOTHING = 1e12
"""Depth of such a pixel, beyond every space."""
SIDE = 8
"""Voxels along a side of a block."""
VOXELS = SIDE**3
# Distance, weight and colour weight as float32, colours as three float16.
BYTES_PER_BLOCK = VOXELS * (3 * 4 + 3 * 2)
LOCAL = np.stack(np.meshgrid(*[np.arange(SIDE, dtype=np.int32)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""[VOXELS, 3] voxels within a block."""
LIMIT = 1 << 20
"""Bound of block coordinates: three of them fit into a key of 63 bits."""
NOWHERE = -(2**31)
"""Block coordinate of pixels without a depth, out of bounds."""
HALF = SIDE // 2
FILLED = 1024
"""Blocks filled from a coarser grid at a time."""
CHUNK = 64
"""Blocks fused at a time: few, so that they stay in the cache."""


@pytree
class Space:
    """The space divided into voxels: even within a radius, and coarser with the distance beyond.

    Voxel i [3] is at y = voxel·i, relative to the centre. Within the radius R, x = y. Beyond it, an unbounded space has
    |x| = R·exp(|y|/R - 1) in the same direction: voxels grow in proportion to their distance, as pixels do.
    """

    center: Array  # [3] position of voxel 0.
    radius: Array  # [] radius within which voxels are even.
    voxel: Array  # [] side of a voxel within the radius.
    is_unbounded: bool = static(default=False)  # Whether the space continues beyond the radius.

    @staticmethod
    def of(center: np.ndarray, radius: float, voxel: float, is_unbounded: bool) -> "Space":
        """Make a space from numbers on the host."""
        return Space(jnp.asarray(center, jnp.float32), jnp.float32(radius), jnp.float32(voxel), is_unbounded)

    def positions(self, indices: Array) -> Array:
        """Return positions [P, 3] of voxels in the world; indices may be fractions."""
        offset = indices.astype(jnp.float32) * self.voxel
        if self.is_unbounded:
            ratio = self._ratio(offset)
            offset = offset * (jnp.exp(ratio - 1) / ratio)
        return self.center[None] + offset

    def indices(self, points: Array) -> Array:
        """Return the indices [P, 3] of positions, as fractions; the inverse of `positions`."""
        offset = points - self.center[None]
        if self.is_unbounded:
            ratio = self._ratio(offset)
            offset = offset * ((1 + jnp.log(ratio)) / ratio)
        return offset / self.voxel

    def _ratio(self, offset: Array) -> Array:
        """Return the lengths [P, 1] of offsets from the centre in radii, at least 1."""
        return jnp.maximum(jnp.linalg.norm(offset, axis=-1, keepdims=True) / self.radius, 1.0)

    def radii(self, points: Array) -> Array:
        """Return the distances [P] of positions from the centre, in radii."""
        distance: Array = jnp.linalg.norm(points - self.center[None], axis=-1)
        return distance / self.radius

    def scale(self, points: Array) -> Array:
        """Return the size [P] of voxels at positions, relative to those within the radius."""
        ratio = self.radii(points)
        return jnp.maximum(ratio, 1.0) if self.is_unbounded else jnp.ones_like(ratio)

    def contains(self, points: Array) -> Array:
        """Return [P] whether positions are within the space."""
        return self.radii(points) <= (FARTHEST if self.is_unbounded else 1.0)


class GridFullError(ValueError):
    """The voxels exceed the memory budget."""


class BlockGrid:
    """Truncated signed distances and colours of voxels, with their weights, in blocks of 8 × 8 × 8 near surfaces.

    A block has integer coordinates [3]: its voxels are 8·block to 8·block + 7. Memory is reserved for as many blocks as
    fit the budget, and used as blocks are made.
    """

    def __init__(self, max_bytes: int):
        """Make an empty grid with a memory budget."""
        self.capacity = max(1, int(max_bytes) // BYTES_PER_BLOCK)
        # Weighted sums of distances, in units of the truncation, and sums of their weights.
        # np.zeros reserves address space only: pages take memory when blocks are written.
        self.distance = np.zeros((self.capacity, VOXELS), np.float32)
        self.weight = np.zeros((self.capacity, VOXELS), np.float32)
        # Mean colours, and sums of their weights.
        self.color = np.zeros((self.capacity, VOXELS, 3), np.float16)
        self.color_weight = np.zeros((self.capacity, VOXELS), np.float32)
        self.coordinates = np.zeros((0, 3), np.int32)
        self._rows: dict[int, int] = {}

    @property
    def num_bytes(self) -> int:
        """Bytes of the blocks that exist."""
        return len(self._rows) * BYTES_PER_BLOCK

    def find(self, blocks: np.ndarray) -> np.ndarray:
        """Return the rows [B] of blocks [B, 3]; -1 where there is none."""
        return np.asarray([self._rows.get(key, -1) for key in _keys_of(blocks).tolist()], np.int64)

    def allocate(self, blocks: np.ndarray) -> np.ndarray:
        """Return the rows of the distinct blocks among blocks [P, 3], after making new ones; far ones are dropped.
        GridFullError: they exceed the memory budget."""
        if len(blocks):  # Neighbouring pixels mostly repeat a block, and sorting is slow.
            blocks = blocks[np.r_[True, (blocks[1:] != blocks[:-1]).any(axis=1)]]
        keys = np.unique(_keys_of(blocks[((blocks > -LIMIT) & (blocks < LIMIT)).all(axis=1)]))
        num = len(self._rows)
        new = [key for key in keys.tolist() if key not in self._rows]
        if num + len(new) > self.capacity:
            raise GridFullError(f"there is room for no more than {self.capacity:,} blocks of voxels")
        self._rows |= zip(new, range(num, num + len(new)), strict=True)
        # A key holds three coordinates of 21 bits, shifted to be positive (`_keys_of`).
        made = [(np.asarray(new, np.int64) >> shift & (2 * LIMIT - 1)) - LIMIT for shift in (42, 21, 0)]
        self.coordinates = np.concatenate([self.coordinates, np.stack(made, axis=-1).astype(np.int32)])
        return np.asarray([self._rows[key] for key in keys.tolist()], np.int64)


def _keys_of(blocks: np.ndarray) -> np.ndarray:
    """Return a unique int64 key [B] for each of the blocks [B, 3]."""
    x, y, z = blocks.astype(np.int64).T + LIMIT
    # LIMIT makes each coordinate positive, below 2^21.
    return x << 42 | y << 21 | z


class RenderedDepth(NamedTuple):
    """Depths and colours of one view."""

    camera: Camera
    depth: Array  # [H, W] along the camera's z axis, at pixel centres; 0 where it is unknown, NOTHING on empty rays.
    spread: Array  # [H, W] standard deviation of the splats' depths, weighted as the depth is.
    slant: Array  # [H, W] in (0, 1]: distance from the surface's plane per distance along the z axis, on the ray.
    facing: Array  # [H, W] cosine between the ray and the surface's normal.
    color: Array  # [H, W, 3] in [0, 1].


def rendered_depth(output: RenderOutput, camera: Camera) -> RenderedDepth:
    """Return the depths of a render."""
    is_opaque = (output.alpha > LEAST_ALPHA) & jnp.isfinite(output.depth)
    alpha = jnp.where(is_opaque, output.alpha, 1.0)
    depth = jnp.where(is_opaque, output.depth, 0.0) / alpha
    # distortion is Σ w_i·w_j·(z_i − z_j)²/2, which is alpha² times the variance.
    spread = jnp.sqrt(jnp.maximum(output.distortion, 0.0)) / alpha
    normal = normalize(output.normal)
    rays = back_project(jnp.ones_like(depth), camera) - camera.center[None, None]
    slant = jnp.abs(jnp.sum(normal * rays, axis=-1))
    # Rays have z = 1: divided by their lengths, slant is the cosine.
    facing = jnp.maximum(slant / jnp.linalg.norm(rays, axis=-1), LEAST_FACING)
    slant = jnp.clip(slant, LEAST_FACING, 1.0)
    color = jnp.clip(jnp.nan_to_num(output.color), 0.0, 1.0)
    depth = jnp.where(is_opaque & (depth > 0), depth, 0.0)
    # Where a view shows nothing, there is nothing on the ray.
    is_empty = output.alpha < EMPTY_ALPHA
    depth = jnp.where(is_empty, NOTHING, depth)
    slant = jnp.where(is_empty, 1.0, slant)
    facing = jnp.where(is_empty, 1.0, facing)
    return RenderedDepth(camera, depth, spread, slant, facing, color)


def fuse(grid: BlockGrid, depths: RenderedDepth, space: Space) -> None:
    """Fuse one view into the blocks within a truncation of its depths. GridFullError: they exceed the memory budget."""
    # On the host: how many blocks there are depends on values.
    rows = grid.allocate(np.asarray(jax.jit(_blocks_near)(depths, space)))
    arrays: tuple[np.ndarray, ...] = grid.distance, grid.weight, grid.color, grid.color_weight
    jitted = jax.jit(_fused)
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        padded = np.resize(chosen, CHUNK)  # Blocks repeat, so that all chunks have one shape.
        fused = jitted([array[padded] for array in arrays], grid.coordinates[padded], depths, space)
        for array, values in zip(arrays, fused, strict=True):
            # Without the repeated rows.
            array[chosen] = np.asarray(values)[: len(chosen)]


def fill(grid: BlockGrid, coarse: BlockGrid, least_weight: float, least_of_coarse: float) -> None:
    """Fill unknown voxels from a grid of voxels twice as large. A voxel is unknown up to the least weight of its grid.

    A depth that is too uncertain for small voxels may be certain enough for large ones, whose truncation is wider.
    """
    for start in range(0, len(grid.coordinates), FILLED):
        rows = np.arange(start, min(start + FILLED, len(grid.coordinates)))
        of_coarse = _interpolated(coarse, grid.coordinates[rows], least_of_coarse)
        is_filled = (of_coarse[..., 0] > 1 - 1e-3) & (grid.weight[rows] <= least_weight)
        # Truncations of the coarse grid are twice as long.
        distance = np.clip(2 * of_coarse[..., 1], -1.0, 1.0)
        weight = of_coarse[..., 2]
        grid.distance[rows] = np.where(is_filled, distance * weight, grid.distance[rows])
        grid.weight[rows] = np.where(is_filled, weight, grid.weight[rows])
        grid.color[rows] = np.where(is_filled[..., None], of_coarse[..., 3:], grid.color[rows])


def _interpolated(coarse: BlockGrid, blocks: np.ndarray, least_weight: float) -> np.ndarray:
    """Return [B, VOXELS, 6] at the voxels of blocks [B, 3], interpolated between voxels twice as large: the share of
    known ones, mean distance, weight, and colour."""
    # A fine block is half a coarse one: its voxels are between HALF + 1 coarse ones along each axis.
    corners = np.stack(np.meshgrid(*[np.arange(HALF + 1)] * 3, indexing="ij"), -1)
    voxels = (blocks[:, None, None, None] * HALF + corners).reshape(-1, 3)
    of_blocks = voxels // SIDE
    _, first, inverse = np.unique(_keys_of(of_blocks), return_index=True, return_inverse=True)
    rows = coarse.find(of_blocks[first])[inverse]
    x, y, z = (voxels % SIDE).T
    local = (x * SIDE + y) * SIDE + z
    weight = np.where(rows >= 0, coarse.weight[rows, local], 0.0)
    is_known = weight > least_weight
    mean = coarse.distance[rows, local] / np.where(is_known, weight, 1.0)
    values = np.column_stack([is_known, mean, weight, coarse.color[rows, local]]).astype(np.float32)
    values *= is_known[:, None]
    values = values.reshape(len(blocks), *corners.shape[:3], -1)
    places = np.arange(SIDE) / 2
    share = np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(HALF + 1))).astype(np.float32)
    return np.einsum("xa,yb,zc,nabcv->nxyzv", share, share, share, values, optimize=True).reshape(
        len(blocks), VOXELS, -1
    )


def _blocks_near(depths: RenderedDepth, space: Space) -> Array:
    """Return blocks [P, 3] around the depths along their rays, with repetitions; NOWHERE without a depth."""
    points = back_project(depths.depth, depths.camera).reshape(-1, 3)
    rays = points - depths.camera.center[None]
    rays = rays / jnp.maximum(jnp.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    reach = (space.voxel * space.scale(points))[:, None]
    is_valid = (depths.depth.reshape(-1) > 0) & space.contains(points)
    blocks = [jnp.floor(space.indices(points + offset * reach * rays) / SIDE) for offset in OFFSETS]
    return jnp.concatenate([jnp.where(is_valid[:, None], block.astype(jnp.int32), NOWHERE) for block in blocks])


def _fused(voxels: list[Array], blocks: Array, depths: RenderedDepth, space: Space) -> tuple[Array, ...]:
    """Return distances, weights, colours and colour weights of blocks [B, 3] after one more view."""
    distance, weight, color, color_weight = voxels
    points = space.positions((blocks[:, None] * SIDE + LOCAL[None]).reshape(-1, 3))
    truncation = TRUNCATION * space.voxel * space.scale(points)
    # Written out: XLA is tens of times slower at multiplying many rows by a 3 × 3 matrix.
    across, down, z = (
        row[0] * points[:, 0] + row[1] * points[:, 1] + row[2] * points[:, 2] + row[3]
        for row in depths.camera.viewmat[:3]
    )
    is_ahead = z > 0
    ahead = jnp.where(is_ahead, z, 1.0)
    # Points behind the camera are far outside of the image.
    x, y = (
        jnp.where(is_ahead, (row[0] * across + row[1] * down) / ahead + row[2], -1e6) for row in depths.camera.K[:2]
    )
    seen, is_seen = _depths_at(depths.depth, x, y, truncation)
    pixel = _pixels(x, y, *depths.depth.shape)
    spread, slant, facing = (image.reshape(-1)[pixel] for image in (depths.spread, depths.slant, depths.facing))
    signed = slant * (seen - z) / truncation
    # 1 to within a voxel behind the surface, falling to 0 at the truncation: a view does not show what is deeper.
    behind = jnp.clip((1 + signed) / (1 - 1 / TRUNCATION), 0.0, 1.0)
    # Far in front of an uncertain depth, it is certain that there is nothing.
    ahead_of = jnp.maximum(slant * (seen - z), truncation)
    sure = facing**2 * behind / (1 + (spread / (SURE * ahead_of)) ** 2)
    # Voxels deeper than a truncation behind the surface are hidden, and unknown to this view.
    added = jnp.where(is_seen & is_ahead & (signed >= -1), sure, 0.0).reshape(-1, VOXELS)
    distance = distance + added * jnp.minimum(signed, 1.0).reshape(-1, VOXELS)
    # Colours count near the surface only, not in the free space before it.
    near = jnp.where(signed.reshape(-1, VOXELS) < 1, added, 0.0)
    color_weight = color_weight + near
    share = near / jnp.maximum(color_weight, 1e-12)
    mixed = []
    for channel in range(3):  # Channel by channel: arrays of three numbers a row stay out of the loops over voxels.
        mean = color[..., channel].astype(jnp.float32)
        shown = depths.color[..., channel].reshape(-1)[pixel].reshape(share.shape)
        mixed.append(mean + share * (shown - mean))
    return distance, weight + added, jnp.stack(mixed, -1).astype(jnp.float16), color_weight


def _depths_at(depth: Array, x: Array, y: Array, truncation: Array) -> tuple[Array, Array]:
    """Return the depth at points [P] of an image, and whether there is one.

    Inverse depths of a plane are linear in the image: they are interpolated where four pixels have depths that differ
    by less than the truncation. Elsewhere the nearest pixel's depth is taken.
    """
    height, width = depth.shape
    flat = depth.reshape(-1)
    # Pixel centres are at half-integers.
    left = jnp.floor(x - 0.5)
    top = jnp.floor(y - 0.5)
    right = x - 0.5 - left
    below = y - 0.5 - top
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
    """Return the indices [P] of the pixels at points, clamped to the border."""
    column = jnp.clip(jnp.floor(x), 0, width - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, height - 1).astype(jnp.int32)
    return row * width + column
