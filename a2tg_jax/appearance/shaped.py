"""Kernels with a shape per Gaussian, in place of the Gaussian falloff of any other appearance.

A generalised Gaussian has an exponent β: β = 1 is the Gaussian, a larger one is flat in the middle and ends at an edge,
a smaller one is peaked and has long tails (GES, Hamdi et al., 2024). At squared distance ρ, in standard deviations, the
falloff is

    exp(−((ρ + δ)^β − δ^β) / ((2 + δ)^β − δ^β)),   δ = 0.02

which is 1 at the centre and 1/e at ρ = 2 for every β, as a Gaussian's is. δ keeps the slope at the centre finite.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.around import AppearanceAround
from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.billboards import Billboards
from a2tg_jax.appearance.plain import Plain
from a2tg_jax.appearance.rule import Factor, Residual, RuleAround, has_gaussian_falloff
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.spread_arrays import rows_moved

SHAPES = "shapes"
"""Name of the shapes in files."""
OFFSET = 0.02
"""δ, in squared standard deviations."""
LARGEST_LOG_EXPONENT = 1.0
"""Largest logarithm of an exponent, and of its inverse."""
MOST_SHARE = 1 - 1e-7
"""Largest tanh of a shape that is read, so that the shape is finite."""
MOST_ROUNDED = 1.5
"""Largest tanh of a shape in a file: half the coarsest step beyond the range."""
LARGEST_RHO = 1e6
"""Squared distance beyond which the falloff is 0 in any case; its powers stay finite up to there."""


REFUSAL = (
    "Shaped replaces a Gaussian falloff and goes around Plain, Textured or another appearance that has one, not "
    "around {}; Banded goes around it, as in Banded(Shaped(Textured()))"
)


class ShapedParams(NamedTuple):
    """Shapes of the kernels, and the parameters of the inner appearance."""

    shapes: Array
    """[N] shapes s of the exponents exp(tanh s); 0 is a Gaussian."""
    inner: Any


class ShapedLayout(NamedTuple):
    """The layout of the inner appearance."""

    inner: Any


class ShapedRates(NamedTuple):
    """Learning rates of the shapes and of the inner appearance."""

    shapes: Any
    inner: Any = 0.0


class Curve(NamedTuple):
    """The exponent of the falloff as a function of ρ: scale·((ρ + δ)^β − start)."""

    exponents: Array
    """β [N]."""
    scales: Array
    """[N] inverse of its increase from ρ = 0 to 2, so that it is 1 there."""
    starts: Array
    """[N] δ^β."""


def exponents_of(shapes: Array) -> Array:
    """Return the exponents β = exp(tanh s), in (1/e, e), of shapes."""
    return jnp.exp(LARGEST_LOG_EXPONENT * jnp.tanh(shapes))


def log_exponents_of(shapes: np.ndarray) -> np.ndarray:
    """Return the logarithms of the exponents of shapes, within ±1, as files keep them (host)."""
    return LARGEST_LOG_EXPONENT * np.tanh(np.asarray(shapes, np.float64))


def shapes_of(log_exponents: np.ndarray) -> np.ndarray:
    """Return the shapes of logarithms of exponents in a file (host).

    Logarithms that rounding has moved beyond ±1 are cut to ±1.

    Raises:
      ValueError: if one is NaN or farther out than rounding moves it.
    """
    shares = np.asarray(log_exponents, np.float64) / LARGEST_LOG_EXPONENT
    if not (np.abs(shares) <= MOST_ROUNDED).all():
        raise ValueError(f"the logarithms of the exponents of kernels must lie within ±{LARGEST_LOG_EXPONENT:g}")
    return np.arctanh(np.clip(shares, -MOST_SHARE, MOST_SHARE))


def curves_of(shapes: Array) -> Curve:
    """Return the curves of shapes [N]."""
    exponents = exponents_of(shapes)
    starts = jnp.exp(exponents * np.log(OFFSET))
    return Curve(exponents, 1 / (jnp.exp(exponents * np.log(2 + OFFSET)) - starts), starts)


def falloff_of(curve: Curve, rho: Array) -> Array:
    """Return kernels at squared distances, which broadcast with the numbers of the curve."""
    rho = jnp.minimum(rho, LARGEST_RHO)
    return jnp.exp(-curve.scales * (jnp.exp(curve.exponents * jnp.log(rho + OFFSET)) - curve.starts))


@pytree
class ShapedRule(RuleAround):
    """Another rule, with a kernel of its own shape for each splat."""

    shapes: Array
    """[N]."""

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        """Return the numbers of the inner rule, followed by the curve."""
        return jnp.concatenate(
            [self.inner.numbers(gaussians, camera), jnp.stack(curves_of(self.shapes), axis=1)], axis=1
        )

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        return self.inner.shade(numbers[: -len(Curve._fields)], values, u, v)

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        return falloff_of(Curve(*numbers[-len(Curve._fields) :]), rho)

    def cutoff(self, opacities: Array) -> Array:
        # The inner bound, of a Gaussian, says at which exponent of the falloff alpha is below 1/255.
        curve, bound = curves_of(self.shapes), self.inner.cutoff(opacities)
        reach = jnp.maximum(bound, 0.0) / (2 * curve.scales) + curve.starts
        return jnp.where(bound > 0, jnp.exp(jnp.log(reach) / curve.exponents) - OFFSET, bound)


@dataclasses.dataclass(frozen=True)
class Shaped(AppearanceAround):
    """Appearance with a kernel of its own shape for each Gaussian, around `Plain` or `Textured`; `Banded` goes around
    it."""

    inner: Appearance = dataclasses.field(default_factory=Plain)

    def __post_init__(self) -> None:
        """Refuse an inner appearance with degrees, with shapes of its own, or of billboards."""
        inner = self.inner
        if inner.has_degrees or inner.shapes_name is not None or isinstance(inner, Billboards):
            raise ValueError(REFUSAL.format(type(inner).__name__))

    @property
    def base(self) -> Appearance:
        return self

    @property
    def is_portable(self) -> bool:
        return type(self) is Shaped and self.inner.is_portable

    @property
    def shapes_name(self) -> str:  # type: ignore[override]
        return SHAPES

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[ShapedParams, ShapedLayout]:
        """Return Gaussians around the parameters of the inner appearance."""
        params, layout = self.inner.allocate(key, gaussians)
        return ShapedParams(jnp.zeros(gaussians.num, gaussians.means.dtype), params), ShapedLayout(layout)

    def rule(self, params: ShapedParams, layout: ShapedLayout) -> ShapedRule:
        inner = self.inner.rule(params.inner, layout.inner)
        if not has_gaussian_falloff(inner):
            raise ValueError(REFUSAL.format(type(self.inner).__name__))
        return ShapedRule(inner, params.shapes)

    def rates(self, rate: Any, params: ShapedParams) -> ShapedParams:
        """Return the rates of `ShapedRates`."""
        return ShapedParams(rate.shapes, self.inner.rates(rate.inner, params.inner))

    def num_floats(self, layout: ShapedLayout, num: int) -> int:
        return num + self.inner.num_floats(layout.inner, num)

    def gather(self, params: ShapedParams, layout: ShapedLayout, rows: Array) -> ShapedParams:
        gathered: ShapedParams = super().gather(params, layout, rows)._replace(shapes=rows_moved(params.shapes, rows))
        return gathered

    def clear(self, params: ShapedParams, layout: ShapedLayout, is_cleared: Array) -> ShapedParams:
        shapes = jnp.where(is_cleared, jnp.zeros_like(params.shapes), params.shapes)
        cleared: ShapedParams = super().clear(params, layout, is_cleared)._replace(shapes=shapes)
        return cleared

    def first_rows(self, params: ShapedParams, layout: ShapedLayout, num: int) -> tuple[ShapedParams, ShapedLayout]:
        params, layout = super().first_rows(params, layout, num)
        return params._replace(shapes=params.shapes[:num]), layout

    def take_rows(
        self, params: ShapedParams, layout: ShapedLayout, rows: np.ndarray
    ) -> tuple[ShapedParams, ShapedLayout]:
        params, layout = super().take_rows(params, layout, rows)
        return params._replace(shapes=params.shapes[rows]), layout

    def joined(self, parts: Sequence[tuple[ShapedParams, ShapedLayout]]) -> tuple[ShapedParams, ShapedLayout]:
        shapes = jnp.concatenate([params.shapes for params, _ in parts])
        params, layout = super().joined(parts)
        return params._replace(shapes=shapes), layout

    def shapes(self, params: ShapedParams) -> Array:
        return params.shapes

    def with_shapes(self, params: ShapedParams, shapes: Array) -> ShapedParams:
        return params._replace(shapes=shapes)

    def check(self, params: ShapedParams, layout: ShapedLayout, gaussians: Gaussians) -> None:
        if params.shapes.shape != (gaussians.num,):
            raise ValueError(
                f"shapes must be [{gaussians.num}], one for each Gaussian; got {list(params.shapes.shape)}"
            )
        super().check(params, layout, gaussians)

    def arrays(self, params: ShapedParams, layout: ShapedLayout) -> dict[str, np.ndarray]:
        """Return `shapes` [N], and the inner appearance's arrays as `inner.NAME`."""
        return {SHAPES: np.asarray(params.shapes)} | super().arrays(params, layout)

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[ShapedParams, ShapedLayout]:
        if SHAPES not in arrays:
            raise ValueError(f"the array {SHAPES} of {type(self).__name__} is missing")
        shapes = arrays[SHAPES]
        if shapes.ndim != 1 or not np.issubdtype(shapes.dtype, np.floating):
            raise ValueError(f"{SHAPES} must be floats [N]; got {shapes.dtype}{list(shapes.shape)}")
        params, layout = self.inner_from_arrays(arrays)
        return ShapedParams(jnp.asarray(shapes), params), ShapedLayout(layout)
