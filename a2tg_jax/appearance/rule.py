"""Appearance rules: what a splat shows at (u, v). The compositor knows nothing else about appearances.

Each of N splats may own a texture of one or more texels among all texels [T, C], and K numbers. At (u, v), in standard
deviations, the rule gives the position of the texture lookup (`texel_position`). From the C interpolated values and the
K numbers it computes a colour residual and an alpha factor (`shade`):

    residual, factor = rule.shade(numbers, texture interpolated at rule.texel_position(region, u, v), u, v)
    α = min(max_alpha, opacity · falloff(numbers, ρ) · factor),  colour = SH colour + residual

`texel_position`, `shade` and `falloff` are element-wise, on scalars or on arrays that broadcast. They see the rule
without its arrays (`StaticRule`): put differentiated values, and values that differ between splats, in the texels or in
the numbers. XLA computes all else for the N splats at once, from any field.
"""

import dataclasses
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import at_least
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.sh import sh_sum

Residual = tuple[Array, ...] | None
"""Added to the D colours; None stands for 0."""
Factor = Array | None
"""Multiplies alpha; None stands for 1."""


class AppearanceRule:
    """Base class of rules: the splat's own colour, weighted by its Gaussian. A subclass is a pytree."""

    max_alpha: float = 0.99
    """Static upper limit of alpha, in (0, 1)."""
    has_low_pass: bool = True
    """Static. Whether the low-pass filter of 2DGS shows splats that are smaller than a pixel or seen edge-on.
    Without it, ρ is u² + v² at the hit of the pixel's ray, and a splat without a hit is invisible."""

    num_colors: int = 3
    """Static number D of colours of a splat: red, green and blue, or as many features."""

    empty: tuple[float, ...] = ()
    """Static C values of a splat without a texture, whose region has no texels; () if all splats have one."""

    texels: Array
    """[T, C] texels of all splats, differentiable; T >= 1, and C >= 1 with textures."""
    regions: TextureRegion | None
    """[N] places of the splats' textures among the texels; None without textures."""

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        """Return the differentiable numbers [N, K] of `shade` and `falloff`, which may depend on the view.

        The renderer calls it once per view, and JAX differentiates it. Gradients of invisible rows are zero.
        """
        return jnp.zeros((gaussians.num, 0), gaussians.means.dtype)

    def opacities(self, gaussians: Gaussians) -> Array:
        """Return the peak opacities [N]."""
        return gaussians.opacities

    def own_colors(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        """Return the colours [N, D] in this view.

        By default, D = 3 of spherical harmonics up to `degree`, which may be traced.
        """
        return at_least(self.own_color_sums(gaussians, camera, degree) + 0.5, 0.0)

    def own_color_sums(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        """Return the sums of spherical harmonics [N, 3] behind `own_colors`, of either sign; linear in them."""
        return sh_sum(gaussians.sh, gaussians.means, camera.center, degree)

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the lookup position (x, y) in texels, clamped to [0, width − 1] and [0, height − 1]."""
        raise NotImplementedError(f"{type(self).__name__} has textures, but does not say where they are looked up")

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        """Return colour residual and alpha factor at (u, v), from the K numbers and the C values of the texture."""
        return None, None

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        """Return the kernel at squared distance rho; exp(−rho/2) for a Gaussian."""
        return jnp.exp(-0.5 * rho)

    def cutoff(self, opacities: Array) -> Array:
        """Return the squared distance rho [N] beyond which alpha is below 1/255; not positive if it always is.

        These are bounds without gradient. Too large a bound costs time, too small a one cuts the splat off.
        """
        return gaussian_cutoff(opacities)


@pytree
class PlainRule(AppearanceRule):
    """Rule of plain 2DGS, and base class of rules without textures."""

    max_alpha: float = dataclasses.field(default=0.99, kw_only=True, metadata={"static": True})

    @property
    def texels(self) -> Array:  # type: ignore[override]
        return jnp.zeros((1, 0), jnp.float32)

    @property
    def regions(self) -> None:  # type: ignore[override]
        return None


@pytree
class RuleAround(AppearanceRule):
    """Base class of rules that change a part of another rule and forward the rest."""

    inner: AppearanceRule

    @property
    def max_alpha(self) -> float:  # type: ignore[override]
        return self.inner.max_alpha

    @property
    def has_low_pass(self) -> bool:  # type: ignore[override]
        return self.inner.has_low_pass

    @property
    def num_colors(self) -> int:  # type: ignore[override]
        return self.inner.num_colors

    @property
    def empty(self) -> tuple[float, ...]:  # type: ignore[override]
        return self.inner.empty

    @property
    def texels(self) -> Array:  # type: ignore[override]
        return self.inner.texels

    @property
    def regions(self) -> TextureRegion | None:  # type: ignore[override]
        return self.inner.regions

    def own_color_sums(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        return self.inner.own_color_sums(gaussians, camera, degree)

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        return self.inner.numbers(gaussians, camera)

    def opacities(self, gaussians: Gaussians) -> Array:
        return self.inner.opacities(gaussians)

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        return self.inner.texel_position(region, u, v)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        return self.inner.shade(numbers, values, u, v)

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        return self.inner.falloff(numbers, rho)

    def cutoff(self, opacities: Array) -> Array:
        return self.inner.cutoff(opacities)


def has_gaussian_falloff(rule: AppearanceRule) -> bool:
    """Return whether a rule keeps the Gaussian falloff, and so does each rule inside."""
    if isinstance(rule, RuleAround) and type(rule).falloff is RuleAround.falloff:
        return has_gaussian_falloff(rule.inner)
    return type(rule).falloff is AppearanceRule.falloff


@pytree
class GivenColors(RuleAround):
    """Another rule with given colours of the Gaussians."""

    given: Array
    """[N, 3] colours."""

    def own_colors(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        return self.given


@pytree
class Features(RuleAround):
    """D features of each splat in place of its colour, with the weights that another rule gives its splats.

    Features have either sign and are not clipped. Textures of the inner rule change alpha only.
    """

    features: Array
    """[N, D] features of the Gaussians, D >= 1."""

    @property
    def num_colors(self) -> int:  # type: ignore[override]
        return self.features.shape[1]

    def own_colors(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        return self.features

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        return None, self.inner.shade(numbers, values, u, v)[1]


@dataclasses.dataclass(frozen=True)
class StaticRule:
    """Rule without its arrays; hashable, so that code can be compiled for it."""

    structure: Any
    """Tree structure of the rule, with the static fields."""

    @staticmethod
    def of(rule: AppearanceRule) -> "StaticRule":
        return StaticRule(jax.tree.structure(rule))

    @property
    def rule(self) -> Any:
        """Rule as its element-wise functions see it: every use of an array field raises."""
        numbered = jax.tree.unflatten(self.structure, range(self.structure.num_leaves))
        paths, _ = jax.tree_util.tree_flatten_with_path(numbered)
        return jax.tree.unflatten(
            self.structure, [_LeftOut(self.name + jax.tree_util.keystr(path)) for path, _ in paths]
        )

    @property
    def name(self) -> str:
        """Name of the rule's class."""
        return self.structure.node_data()[0].__name__


class _LeftOut:
    """Stand-in for an array of a rule. Every use raises an error with a remedy."""

    def __init__(self, name: str):
        self._name = name

    def _refuse(self, *_: Any) -> NoReturn:
        raise ValueError(
            f"{self._name} is an array, and texel_position, shade and falloff see the static fields of a rule only: "
            "return it from numbers(), or put it in the texels"
        )

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self._refuse()

    # A property: JAX asks whether there is such a method, and its own error would name neither field nor rule.
    __jax_array__ = property(_refuse)
    __array__ = __getitem__ = __iter__ = __len__ = __bool__ = __float__ = __int__ = _refuse
    __add__ = __sub__ = __mul__ = __truediv__ = __pow__ = __neg__ = __abs__ = __matmul__ = _refuse
    __radd__ = __rsub__ = __rmul__ = __rtruediv__ = __rpow__ = __rmatmul__ = _refuse
    __lt__ = __le__ = __gt__ = __ge__ = _refuse


def gaussian_cutoff(peak: Array) -> Array:
    """Return r² = 2·ln(255·peak), at which peak·exp(−r²/2) = 1/255; negative if the peak is not positive."""
    return 2 * jnp.log(jnp.maximum(255 * peak, 1e-6))
