"""Appearance rules: what a splat shows at (u, v). The compositor is given one and knows nothing else about it.

A rule has a table of parameters [T, C], of which each splat owns an image of one texel or more. At (u, v), in standard
deviations, the rule says where that image is looked up (`texel`), and what the C numbers found there make visible
(`shade`):

    residual, factor = rule.shade(interpolated image at rule.texel(image, u, v), u, v)

`texel`, `shade` and `falloff` are element-wise, on scalars or on arrays that broadcast. They may use nothing of the
rule but its static fields: everything else comes as an argument, and what is differentiated comes in `values`.
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.bilinear import Image


class AppearanceRule(Protocol):
    """What the compositor asks of a rule, a pytree that is hashable but for its arrays."""

    @property
    def params(self) -> Array:
        """[T, C] the differentiable parameters; T >= 1, and C >= 1 where there are images."""
        ...

    @property
    def images(self) -> Image | None:
        """[N] each: the splats' images in the table. None where nothing of it is read."""
        ...

    def texel(self, image: Image, u: Array, v: Array) -> tuple[Array, Array]:
        """(x, y) where an image is looked up, in texels, held in [0, width − 1] and [0, height − 1]."""
        ...

    def shade(
        self, values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[tuple[Array, Array, Array] | None, Array | None]:
        """Colour residuals and the alpha factor at (u, v), given what the image shows there, C numbers; None stands
        for 0 and for 1."""
        ...

    def falloff(self, rho: Array) -> Array:
        """The kernel at squared distance rho; exp(−rho/2) for a Gaussian."""
        ...

    def cutoff(self, opacities: Array) -> Array:
        """[N] squared distance rho beyond which the splat shows less than 1/255; not positive where it never does."""
        ...

    @property
    def num_bytes(self) -> int:
        """Reported memory of the parameters, padding left out (host)."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainAppearance:
    """Plain 2DGS: the splat's own colour, weighted by its Gaussian."""

    @property
    def params(self) -> Array:
        return jnp.zeros((1, 0), jnp.float32)

    @property
    def images(self) -> None:
        return None

    def texel(self, image: Image, u: Array, v: Array) -> tuple[Array, Array]:
        raise NotImplementedError("plain splats have no images")

    def shade(self, values: tuple[Array, ...], u: Array, v: Array) -> tuple[None, None]:
        return None, None

    def falloff(self, rho: Array) -> Array:
        return jnp.exp(-0.5 * rho)

    def cutoff(self, opacities: Array) -> Array:
        return gaussian_cutoff(opacities)

    @property
    def num_bytes(self) -> int:
        return 0


def gaussian_cutoff(peak: Array) -> Array:
    """r² = 2·ln(255·peak), where peak·exp(−r²/2) = 1/255; peaks that are not positive give a negative r²."""
    return 2 * jnp.log(jnp.maximum(255 * peak, 1e-6))
