"""Bilinear interpolation in the image of a splat: a part of a table [T, C], row by row.

Every function is element-wise: it takes scalars, or arrays that broadcast. (x, y) counts texels from the centre of the
first one and lies in [0, width − 1] × [0, height − 1].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class Image(NamedTuple):
    """Where the image of a splat lies in the table; int32."""

    first: Array
    """The entry that is its first texel."""
    height: Array
    width: Array


class Tap(NamedTuple):
    """One of the four texels around (x, y)."""

    entry: Array
    """Of the table."""
    weight: Array
    slope_x: Array
    """Derivative of the weight by x, within the cell."""
    slope_y: Array


class Sample(NamedTuple):
    """What an image shows at (x, y), C numbers each."""

    values: tuple[Array, ...]
    slope_x: tuple[Array, ...]
    """Derivatives by x, within the cell."""
    slope_y: tuple[Array, ...]


def taps(image: Image, x: Array, y: Array) -> tuple[Tap, ...]:
    """The texels above left, above right, below left and below right of (x, y)."""
    right_most, bottom_most = image.width - 1, image.height - 1
    # Whatever x and y are, nothing outside of the image is read.
    left = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, right_most)
    top = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, bottom_most)
    right, bottom = jnp.minimum(left + 1, right_most), jnp.minimum(top + 1, bottom_most)
    above, below = image.first + top * image.width, image.first + bottom * image.width
    fx, fy = x - left.astype(x.dtype), y - top.astype(y.dtype)
    gx, gy = 1 - fx, 1 - fy
    return (
        Tap(above + left, gx * gy, -gy, -gx),
        Tap(above + right, fx * gy, gy, -fx),
        Tap(below + left, gx * fy, -fy, gx),
        Tap(below + right, fx * fy, fy, fx),
    )


def interpolate(found: tuple[Tap, ...], texels: tuple[tuple[Array, ...], ...]) -> Sample:
    """The sample, given the C numbers of each tap's texel."""

    def weighed(weights):
        return tuple(
            sum(weight * number for weight, number in zip(weights, column, strict=True))
            for column in zip(*texels, strict=True)
        )

    return Sample(*(weighed([tap[k] for tap in found]) for k in (1, 2, 3)))


def follow(sample: Sample, x: Array, y: Array) -> tuple[Array, ...]:
    """The sample's values, with the derivatives that they have where (x, y) moves."""
    dx, dy = x - jax.lax.stop_gradient(x), y - jax.lax.stop_gradient(y)
    columns = zip(*sample, strict=True)
    return tuple(value + slope_x * dx + slope_y * dy for value, slope_x, slope_y in columns)
