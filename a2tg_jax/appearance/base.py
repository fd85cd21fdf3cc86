"""The interface of appearances: static values that allocate, show, project and count what a model's splats show.

An appearance is hashable and holds options only. Its parameters travel beside it: `params`, a pytree of float arrays
that training differentiates, and `layout`, integers beside them.

    params, layout = appearance.allocate(key, gaussians)
    rule = appearance.rule(params, layout)          # for the renderer
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax import Array

from a2tg_jax.appearance.options import TextureOptions
from a2tg_jax.appearance.rows import MovableRows
from a2tg_jax.appearance.rule import AppearanceRule
from a2tg_jax.appearance.sh_bands import BandLayout, Bands
from a2tg_jax.appearance.stored import StoredArrays, parameter_shapes
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.texture import AtlasLayout, Textures

WITH_TEXTURES = "a model with textures is Model(gaussians, textures, layout, appearance=Textured())"


def _with_wrapper(name: str) -> str:
    """Return how to make a model whose appearance is wrapped by the class of that name."""
    return (
        f"say shown = {name}(appearance), params, layout = shown.allocate(key, gaussians), and "
        "Model(gaussians, params, layout, appearance=shown)"
    )


@dataclasses.dataclass(frozen=True)
class Appearance(MovableRows, StoredArrays):
    """Appearance of splats. The defaults suit an appearance whose parameters have one row per Gaussian and no layout.

    A subclass overrides `allocate` and `rule`, and whatever else differs. Callers ask for capabilities (`is_linear`,
    `texture_options`, `has_degrees`, …), never for a class: each defaults to no.
    """

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[Any, Any]:
        """Return initial parameters and layout for N Gaussians (host)."""
        return (), ()

    def rule(self, params: Any, layout: Any) -> AppearanceRule:
        """Return the rule that the renderer is given; traceable, and differentiable in `params`."""
        raise NotImplementedError(f"{type(self).__name__} must say which appearance rule shows it")

    def project(self, params: Any) -> Any:
        """Return the parameters moved to where they are allowed, after an update; traceable."""
        return params

    def rates(self, rate: Any, params: Any) -> Any:
        """Return Adam's learning rates, a prefix of the parameters' tree, from those of a stage; traceable."""
        return rate

    def num_floats(self, layout: Any, num: int) -> int:
        """Return the trained floats of `num` live Gaussians, without those of `Gaussians` and padding (host)."""
        per_row = sum(np.prod(leaf.shape[1:], dtype=int) for leaf in jax.tree.leaves(parameter_shapes(self)[0]))
        return int(per_row) * num

    def num_published_floats(self, layout: Any, num: int) -> int:
        """Return the floats as the method's authors count them (host)."""
        return self.num_floats(layout, num)

    # Capabilities.

    @property
    def base(self) -> "Appearance":
        """The appearance inside wrappers that change nothing but colours. `Banded` has the base of what it wraps."""
        return self

    @property
    def layers(self) -> tuple["Appearance", ...]:
        """The appearance, and what it wraps, from the outermost to the innermost."""
        return (self,)

    @property
    def is_linear(self) -> bool:
        """Whether a picture is linear in spherical harmonics and in the RGB of `textures`."""
        return False

    @property
    def texture_options(self) -> TextureOptions | None:
        """How textures that may differ in size are read; None without such textures."""
        return None

    @property
    def has_degrees(self) -> bool:
        """Whether each Gaussian has a degree of spherical harmonics of its own."""
        return False

    def textures(self, params: Any, layout: Any) -> tuple[Textures, AtlasLayout] | None:
        """Return textures and their layout; None without textures."""
        return None

    def with_textures(self, params: Any, layout: Any, textures: Textures, atlas: AtlasLayout) -> tuple[Any, Any]:
        """Return parameters and layout with other textures.

        Raises:
          ValueError: if the appearance has no textures.
        """
        raise ValueError(f"{type(self).__name__} has no textures to replace: {WITH_TEXTURES}")

    def bands(self, params: Any, layout: Any) -> tuple[Bands, BandLayout] | None:
        """Return the coefficients beyond those of `Gaussians.sh`, and their owners; None without degrees."""
        return None

    def with_bands(self, params: Any, layout: Any, bands: Bands, owners: BandLayout) -> tuple[Any, Any]:
        """Return parameters and layout with other coefficients.

        Raises:
          ValueError: if the appearance has no degrees per Gaussian.
        """
        raise ValueError(f"{type(self).__name__} has no degrees per Gaussian to replace: {_with_wrapper('Banded')}")

    def shapes(self, params: Any) -> Array | None:
        """Return the shapes [N] of the kernels; None if all are Gaussians."""
        return None

    def with_shapes(self, params: Any, shapes: Array) -> Any:
        """Return parameters with other shapes of the kernels.

        Raises:
          ValueError: if the appearance has no shapes.
        """
        raise ValueError(f"{type(self).__name__} has no shapes of kernels to replace: {_with_wrapper('Shaped')}")
