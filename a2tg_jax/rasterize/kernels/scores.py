"""Scores of two images by windows: by native loops on CPUs (`native.ssim`), by plain array code elsewhere (`windows`).

Every derivative exists, in forward and reverse mode; those of the gradient are of plain array code.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero

from a2tg_jax.rasterize.kernels import windows
from a2tg_jax.rasterize.kernels.by_platform import by_platform
from a2tg_jax.rasterize.kernels.choice import is_available
from a2tg_jax.rasterize.kernels.windows import Score


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def mean_score(score: Score, x: Array, y: Array) -> Array:
    """Return the average over all windows of images [C, H, W]."""
    mean: Array = by_platform(_code_of, ("mean_score", score), jax.ShapeDtypeStruct((), jnp.result_type(x, y)), x, y)
    return mean


@functools.partial(mean_score.defjvp, symbolic_zeros=True)
def _mean_score_jvp(score: Score, primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    value, *slopes = value_and_slopes(score, *primals)
    terms = [
        jnp.sum(slope * tangent)
        for slope, tangent in zip(slopes, tangents, strict=True)
        if not isinstance(tangent, SymbolicZero)
    ]
    return value, sum(terms, jnp.zeros_like(value))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def value_and_slopes(score: Score, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the average, and its derivatives by x and y; under jit, XLA drops one that is not used."""
    value = jax.ShapeDtypeStruct((), jnp.result_type(x, y))
    slopes = (jax.ShapeDtypeStruct(image.shape, image.dtype) for image in (x, y))
    found: tuple[Array, Array, Array] = by_platform(_code_of, ("value_and_slopes", score), (value, *slopes), x, y)
    return found


@value_and_slopes.defjvp
def _value_and_slopes_jvp(score: Score, primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Any, Any]:
    plain = functools.partial(windows.value_and_slopes, score)
    return value_and_slopes(score, *primals), jax.jvp(plain, primals, tangents)[1]


def _code_of(platform: str, name: str, score: Score) -> Callable[[Array, Array], Any]:
    """Return a function of `windows`, or that of `native.ssim` where native loops run and take the images."""

    def code(x: Array, y: Array) -> Any:
        module: Any = windows
        if is_available("native", platform) and x.dtype == y.dtype and x.dtype in (jnp.float32, jnp.float64):
            from a2tg_jax.rasterize.kernels.native import ssim

            module = ssim if x.shape[2] >= ssim.least_width(x.dtype, len(score.taps)) else windows
        return getattr(module, name)(score, x, y)

    return code
