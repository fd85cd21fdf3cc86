"""Wrappers around an appearance, and the one place where they forward to it."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.options import TextureOptions
from a2tg_jax.appearance.sh_bands import BandLayout, Bands
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.texture import AtlasLayout, Textures

INNER = "inner."


@dataclasses.dataclass(frozen=True)
class AppearanceAround(Appearance):
    """Wrapper that shows another appearance; a subclass adds to it.

    Parameters and layout are named tuples with a field `inner`, which belongs to the wrapped appearance. Every method
    changes that field only. A subclass calls these methods and changes its own fields; it provides `allocate`,
    `rule`, `rates`, `num_floats` and `from_arrays`.
    """

    inner: Appearance

    @property
    def base(self) -> Appearance:
        return self.inner.base

    @property
    def layers(self) -> tuple[Appearance, ...]:
        return (self, *self.inner.layers)

    @property
    def is_linear(self) -> bool:
        return self.inner.is_linear

    @property
    def texture_options(self) -> TextureOptions | None:
        return self.inner.texture_options

    @property
    def has_degrees(self) -> bool:
        return self.inner.has_degrees

    @property
    def has_own_opacities(self) -> bool:
        return self.inner.has_own_opacities

    @property
    def max_alpha(self) -> float:  # type: ignore[override]
        return self.inner.max_alpha

    @property
    def has_low_pass(self) -> bool:  # type: ignore[override]
        return self.inner.has_low_pass

    @property
    def array_prefix(self) -> str:  # type: ignore[override]
        return INNER + self.inner.array_prefix

    @property
    def shapes_name(self) -> str | None:  # type: ignore[override]
        return None if self.inner.shapes_name is None else INNER + self.inner.shapes_name

    def project(self, params: Any) -> Any:
        return params._replace(inner=self.inner.project(params.inner))

    def gather(self, params: Any, layout: Any, rows: Array) -> Any:
        return params._replace(inner=self.inner.gather(params.inner, layout.inner, rows))

    def clear(self, params: Any, layout: Any, is_cleared: Array) -> Any:
        return params._replace(inner=self.inner.clear(params.inner, layout.inner, is_cleared))

    def share(self, gaussians: Gaussians, params: Any, layout: Any, num_shares: Array) -> tuple[Gaussians, Any]:
        gaussians, inner = self.inner.share(gaussians, params.inner, layout.inner, num_shares)
        return gaussians, params._replace(inner=inner)

    def opacities(self, gaussians: Gaussians, params: Any, layout: Any) -> Array:
        return self.inner.opacities(gaussians, params.inner, layout.inner)

    def limit_opacities(self, gaussians: Gaussians, params: Any, layout: Any, most: Array) -> tuple[Gaussians, Any]:
        gaussians, inner = self.inner.limit_opacities(gaussians, params.inner, layout.inner, most)
        return gaussians, params._replace(inner=inner)

    def first_rows(self, params: Any, layout: Any, num: int) -> tuple[Any, Any]:
        inner, inner_layout = self.inner.first_rows(params.inner, layout.inner, num)
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    def take_rows(self, params: Any, layout: Any, rows: np.ndarray) -> tuple[Any, Any]:
        inner, inner_layout = self.inner.take_rows(params.inner, layout.inner, rows)
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    def joined(self, parts: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        inner, inner_layout = self.inner.joined([(params.inner, layout.inner) for params, layout in parts])
        params, layout = parts[0]
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    def check(self, params: Any, layout: Any, gaussians: Gaussians) -> None:
        self.inner.check(params.inner, layout.inner, gaussians)

    def textures(self, params: Any, layout: Any) -> tuple[Textures, AtlasLayout] | None:
        return self.inner.textures(params.inner, layout.inner)

    def with_textures(self, params: Any, layout: Any, textures: Textures, atlas: AtlasLayout) -> tuple[Any, Any]:
        inner, inner_layout = self.inner.with_textures(params.inner, layout.inner, textures, atlas)
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    def bands(self, params: Any, layout: Any) -> tuple[Bands, BandLayout] | None:
        return self.inner.bands(params.inner, layout.inner)

    def with_bands(self, params: Any, layout: Any, bands: Bands, owners: BandLayout) -> tuple[Any, Any]:
        inner, inner_layout = self.inner.with_bands(params.inner, layout.inner, bands, owners)
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    def shapes(self, params: Any) -> Array | None:
        return self.inner.shapes(params.inner)

    def with_shapes(self, params: Any, shapes: Array) -> Any:
        return params._replace(inner=self.inner.with_shapes(params.inner, shapes))

    def arrays(self, params: Any, layout: Any) -> dict[str, np.ndarray]:
        """Return the arrays of the wrapped appearance, as `inner.NAME`."""
        arrays = self.inner.arrays(params.inner, layout.inner)
        return {INNER + name: array for name, array in arrays.items()}

    def inner_from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[Any, Any]:
        """Return parameters and layout of the wrapped appearance, from all arrays of this one."""
        return self.inner.from_arrays(
            {name.removeprefix(INNER): array for name, array in arrays.items() if name.startswith(INNER)}
        )
