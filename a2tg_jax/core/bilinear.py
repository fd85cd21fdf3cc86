"""Bilinear interpolation in a splat's texture: the texels around a position, and their weights.

The textures of all splats are in one array of texels [T, C], each a `TextureRegion` of it, row by row. Functions are
element-wise, on scalars or on arrays that broadcast. (x, y) counts texels from the centre of the first one and is in
[0, width − 1] × [0, height − 1]. `rasterize.kernels.native.texture_lookups` does the same for vectors of pixels.
"""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class TextureRegion(NamedTuple):
    """Place of a splat's texture among all texels; int32."""

    first: Array
    """Index of its first texel."""
    height: Array
    """Height in texels; 0 without a texture."""
    width: Array
    """Width in texels; 0 without a texture."""


def within_texels(regions: TextureRegion, num_texels: int) -> TextureRegion:
    """Return regions moved and cut so that all their texels are among `num_texels`; kernels do not check them."""
    # Each limit uses those before it, so that first + height·width <= num_texels.
    height = jnp.where(regions.width > 0, jnp.clip(regions.height, 0, num_texels), 0)
    width = jnp.where(height > 0, jnp.clip(regions.width, 0, num_texels // jnp.maximum(height, 1)), 0)
    first = jnp.clip(regions.first, 0, num_texels - height * width)
    return TextureRegion(first.astype(jnp.int32), height.astype(jnp.int32), width.astype(jnp.int32))


class Corner(NamedTuple):
    """One of the four texels around (x, y)."""

    texel: Array  # Index among all texels.
    weight: Array  # Bilinear weight, in [0, 1].
    slope_x: Array  # Derivative of the weight by x, within the cell.
    slope_y: Array


class Sample(NamedTuple):
    """C interpolated values at (x, y), and their derivatives by x and by y within the cell."""

    values: tuple[Array, ...]
    slope_x: tuple[Array, ...]
    slope_y: tuple[Array, ...]


class Lookup(NamedTuple):
    """A sample of a splat's texture, and the texels it was read from."""

    region: TextureRegion
    sample: Sample
    corners: tuple[Corner, ...] = ()  # Empty if the kernel finds the texels' cotangents in another way.


def corners_of(region: TextureRegion, x: Array, y: Array) -> tuple[Corner, ...]:
    """Return the texels above left, above right, below left and below right of (x, y); weight 0 without a texture."""
    right_most = jnp.maximum(region.width - 1, 0)
    bottom_most = jnp.maximum(region.height - 1, 0)
    # Clipped, so that no x or y reads outside the texture.
    left = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, right_most)
    top = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, bottom_most)
    # Beyond the last texel the weight is 0, because x <= width − 1: any index inside is right.
    right = jnp.minimum(left + 1, right_most)
    bottom = jnp.minimum(top + 1, bottom_most)
    above = region.first + top * region.width
    below = region.first + bottom * region.width
    exists = (region.width > 0).astype(x.dtype)
    # Without a texture all four weights are 0, and nothing is read into the sum.
    fx = exists * (x - left.astype(x.dtype))
    fy = exists * (y - top.astype(y.dtype))
    gx = exists - fx
    gy = exists - fy
    # The slopes follow from ∂fx/∂x = 1 and ∂gx/∂x = −1.
    return (
        Corner(above + left, gx * gy, -gy, -gx),
        Corner(above + right, fx * gy, gy, -fx),
        Corner(below + left, gx * fy, -fy, gx),
        Corner(below + right, fx * fy, fy, fx),
    )


def interpolate(corners: tuple[Corner, ...], texels: tuple[tuple[Array, ...], ...]) -> Sample:
    """Return the sample, given the C numbers of each corner's texel."""

    columns = list(zip(*texels, strict=True))

    def weighed(weights: list[Array]) -> tuple[Array, ...]:
        return tuple(sum(map(operator.mul, weights, column)) for column in columns)

    return Sample(
        values=weighed([corner.weight for corner in corners]),
        slope_x=weighed([corner.slope_x for corner in corners]),
        slope_y=weighed([corner.slope_y for corner in corners]),
    )


def or_empty(sample: Sample, region: TextureRegion, empty: tuple[float, ...]) -> Sample:
    """Return the sample, or the values `empty` if the region has no texels."""
    # Then every splat has a texture, and kernels need no test.
    if not empty:
        return sample
    values = zip(empty, sample.values, strict=True)
    return sample._replace(values=tuple(jnp.where(region.width > 0, value, default) for default, value in values))


def follow(sample: Sample, x: Array, y: Array) -> tuple[Array, ...]:
    """Return the sample's values, differentiable in (x, y)."""
    # Both are 0 and only carry the derivative: texels are read once, and JAX does not differentiate the lookup itself.
    dx = x - jax.lax.stop_gradient(x)
    dy = y - jax.lax.stop_gradient(y)
    columns = zip(*sample, strict=True)
    return tuple(value + slope_x * dx + slope_y * dy for value, slope_x, slope_y in columns)
