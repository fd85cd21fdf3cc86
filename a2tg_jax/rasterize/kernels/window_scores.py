"""Scores of two images by windows: the average of a function of the means of x, y, x² + y² and x·y (SSIM).

Native loops compute them on CPUs (`native.ssim`), plain array code elsewhere. Every derivative exists, in forward and
reverse mode; second ones are of plain array code.
"""

import functools
import importlib
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from a2tg_jax.rasterize.kernels.platforms import by_platform, is_available
from a2tg_jax.rasterize.kernels.score import Score


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def mean_score(score: Score, x: Array, y: Array) -> Array:
    """Return the average over all windows of images [C, H, W]."""
    # Under jit, XLA drops the slopes, which are not used.
    return value_and_slopes(score, x, y)[0]


@functools.partial(mean_score.defjvp, symbolic_zeros=True)
def _mean_score_jvp(score: Score, primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    value, *slopes = value_and_slopes(score, *primals)
    # Mostly y is a photograph, whose tangent is zero: its slope is then not computed.
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
    return by_platform(_code_of, (score,), (value, *slopes), x, y)


@value_and_slopes.defjvp
def _value_and_slopes_jvp(score: Score, primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Any, Any]:
    plain = functools.partial(plain_value_and_slopes, score)
    return value_and_slopes(score, *primals), jax.jvp(plain, primals, tangents)[1]


def _code_of(platform: str, score: Score) -> Callable[[Array, Array], Any]:
    """Return a function of plain array code, or of `native.ssim` where native loops run and take the images."""

    def code(x: Array, y: Array) -> Any:
        if is_available("native", platform) and x.dtype == y.dtype and x.dtype in (jnp.float32, jnp.float64):
            ssim = importlib.import_module(f"{__package__}.native.ssim")  # Here, where llvmlite is installed.
            if x.shape[2] >= ssim.least_width(x.dtype, len(score.taps)):
                return ssim.value_and_slopes(score, x, y)
        return plain_value_and_slopes(score, x, y)

    return code


def plain_value_and_slopes(score: Score, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the average, and its derivatives by x and y, by array code."""

    def mean(x: Array, y: Array) -> Array:
        # The mean of y is blurred separately, so that no gradient is computed for it where y is constant. The two
        # second moments are needed only as their sum: four blurs instead of five.
        blurred = window_mean(jnp.concatenate([x, x * x + y * y, x * y]), score.taps)
        mean_x, mean_squares, mean_product = jnp.split(blurred, 3)
        return jnp.mean(score.function(mean_x, window_mean(y, score.taps), mean_squares, mean_product))

    value, slopes = jax.value_and_grad(mean, argnums=(0, 1))(x, y)
    return value, *slopes


def window_mean(images: Array, taps: tuple[float, ...]) -> Array:
    """Return the mean weighted by T × T symmetric taps, where the window fits: [..., H, W] → [..., H-T+1, W-T+1]."""
    return window_mean_p.bind(images, taps=taps)


def _window_mean(images: Array, *, taps: tuple[float, ...]) -> Array:
    num = len(taps)
    half = len(taps) // 2
    # Along each axis a sum of shifted slices, which is faster than a convolution on CPUs.
    for axis in (images.ndim - 2, images.ndim - 1):
        size = images.shape[axis] - num + 1
        shifted = [jax.lax.slice_in_dim(images, tap, tap + size, axis=axis) for tap in range(num)]
        terms = [shifted[half] * taps[half]] if num % 2 else []
        terms += [(shifted[tap] + shifted[-1 - tap]) * taps[tap] for tap in range(half)]
        # Without the barrier XLA fuses the two passes into one of T² taps.
        images = jax.lax.optimization_barrier(functools.reduce(operator.add, terms))
    return images


def _shape(images: Any, *, taps: tuple[float, ...]) -> Any:
    *leading, height, width = images.shape
    return images.update(shape=(*leading, height - len(taps) + 1, width - len(taps) + 1))


def _transposed(cotangent: Array, _: object, *, taps: tuple[float, ...]) -> list[Array]:
    """Return the same mean of the padded cotangent, as the window is symmetric; transposed slices would be slow."""
    margin = len(taps) - 1
    padded = jnp.pad(cotangent, [(0, 0)] * (cotangent.ndim - 2) + [(margin, margin)] * 2)
    return [window_mean(jax.lax.optimization_barrier(padded), taps)]


def _batched(arguments: tuple[Array], axes: tuple[int], *, taps: tuple[float, ...]) -> tuple[Array, int]:
    return window_mean(jnp.moveaxis(arguments[0], axes[0], 0), taps), 0


window_mean_p = Primitive("a2tg_window_mean")
window_mean_p.def_impl(_window_mean)
window_mean_p.def_abstract_eval(_shape)
ad.deflinear2(window_mean_p, _transposed)
batching.primitive_batchers[window_mean_p] = _batched
mlir.register_lowering(window_mean_p, mlir.lower_fun(_window_mean, multiple_results=False))
