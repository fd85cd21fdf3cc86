"""Scores of two images by windows, in plain array code: the average of a function of the means of x, y, x² + y², x·y.

`native.ssim` has the same on CPUs, faster; `scores` chooses. Every derivative exists, in forward and reverse mode.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


class Score(NamedTuple):
    """Score to average over windows; hashable."""

    function: Callable[[Array, Array, Array, Array], Array]
    """Element-wise function of the means of x, y, x² + y² and x·y."""
    taps: tuple[float, ...]
    """Weights of a window along one axis, symmetric."""


def mean_score(score: Score, x: Array, y: Array) -> Array:
    """Return the average over all windows of images [C, H, W]."""
    # The mean of y is blurred apart, so that no gradient is computed for it where y is constant. The two second moments
    # are needed only as their sum: four blurs instead of five.
    blurred = window_mean(jnp.concatenate([x, x * x + y * y, x * y]), score.taps)
    mean_x, mean_squares, mean_product = jnp.split(blurred, 3)
    return jnp.mean(score.function(mean_x, window_mean(y, score.taps), mean_squares, mean_product))


def value_and_slopes(score: Score, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the average, and its derivatives by x and y."""
    value, slopes = jax.value_and_grad(functools.partial(mean_score, score), argnums=(0, 1))(x, y)
    return value, *slopes


def window_mean(images: Array, taps: tuple[float, ...]) -> Array:
    """Return the weighted mean under a window of T × T at every place where it fits: [..., H, W] → [..., H-T+1, W-T+1].

    Args:
      images: [..., H, W], at least as large as the window.
      taps: T weights along one axis, symmetric.
    """
    mean: Array = window_mean_p.bind(images, taps=taps)
    return mean


def _window_mean(images: Array, *, taps: tuple[float, ...]) -> Array:
    return _blur(_blur(images, taps, images.ndim - 2), taps, images.ndim - 1)


def _blur(x: Array, taps: tuple[float, ...], axis: int) -> Array:
    """Apply the taps along one axis, as a sum of shifted slices (faster than a convolution on CPUs)."""
    num, half = len(taps), len(taps) // 2
    size = x.shape[axis] - num + 1
    shifted = [jax.lax.slice_in_dim(x, tap, tap + size, axis=axis) for tap in range(num)]
    pairs = [(shifted[tap] + shifted[-1 - tap]) * taps[tap] for tap in range(half)]
    middle = [shifted[half] * taps[half]] if num % 2 else []
    # Without the barrier XLA fuses the two passes into one of T² taps.
    kept: Array = jax.lax.optimization_barrier(functools.reduce(operator.add, middle + pairs))
    return kept


def _shape(images: Any, *, taps: tuple[float, ...]) -> Any:
    *leading, height, width = images.shape
    return images.update(shape=(*leading, height - len(taps) + 1, width - len(taps) + 1))


def _transposed(cotangent: Array, _: Any, *, taps: tuple[float, ...]) -> list[Array]:
    """Return the same mean of the padded cotangent, as the window is symmetric; that of slices would be slow."""
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
