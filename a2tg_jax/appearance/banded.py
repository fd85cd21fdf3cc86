"""Spherical harmonics of a degree per Gaussian, beside whatever else a splat shows."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.plain import Plain
from a2tg_jax.appearance.rule import RuleAround
from a2tg_jax.appearance.sh_bands import (
    BandLayout,
    Bands,
    allocate_bands,
    band_colors,
    clear_bands,
    dense_sh,
    first_bands,
    gather_bands,
    split_sh,
)
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.texture import AtlasLayout, Textures


class BandedParams(NamedTuple):
    """Coefficients beyond those that all Gaussians have, and the parameters of what else is shown."""

    bands: Bands
    inner: Any


class BandedLayout(NamedTuple):
    """Whose the coefficients are, and the layout of what else is shown."""

    bands: BandLayout
    inner: Any

    @property
    def num(self) -> int:
        """Number of Gaussians."""
        return self.bands.num


class BandedRates(NamedTuple):
    """Learning rates of the coefficients, and what a stage says of those of what else is shown."""

    bands: Any
    inner: Any = 0.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BandedRule(RuleAround):
    """Another rule, with colours of more spherical harmonics for some Gaussians."""

    bands: Bands
    layout: BandLayout

    def own_color_sums(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        own = self.inner.own_color_sums(gaussians, camera, degree)
        return own + band_colors(self.bands, self.layout, gaussians.means, camera.center, degree)


@dataclasses.dataclass(frozen=True)
class Banded(Appearance):
    """What another appearance shows, and view dependence of a degree per Gaussian."""

    inner: Appearance = dataclasses.field(default_factory=Plain)

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[BandedParams, BandedLayout]:
        degrees = np.full(gaussians.num, gaussians.sh_degree)
        bands, owners = allocate_bands(degrees, gaussians.sh_degree, gaussians.means.dtype)
        params, layout = self.inner.allocate(key, gaussians)
        return BandedParams(bands, params), BandedLayout(owners, layout)

    def rule(self, params: BandedParams, layout: BandedLayout) -> BandedRule:
        return BandedRule(self.inner.rule(params.inner, layout.inner), params.bands, layout.bands)

    def project(self, params: BandedParams) -> BandedParams:
        return params._replace(inner=self.inner.project(params.inner))

    def rates(self, rate: Any, params: BandedParams) -> BandedParams:
        """`BandedRates`."""
        return BandedParams(rate.bands, self.inner.rates(rate.inner, params.inner))

    def num_floats(self, layout: BandedLayout, num: int) -> int:
        return layout.bands.count_floats(num) + self.inner.num_floats(layout.inner, num)

    def gather(self, params: BandedParams, layout: BandedLayout, rows: Array) -> BandedParams:
        inner = self.inner.gather(params.inner, layout.inner, rows)
        return BandedParams(gather_bands(params.bands, layout.bands, rows), inner)

    def clear(self, params: BandedParams, layout: BandedLayout, is_cleared: Array) -> BandedParams:
        inner = self.inner.clear(params.inner, layout.inner, is_cleared)
        return BandedParams(clear_bands(params.bands, layout.bands, is_cleared), inner)

    def share(self, gaussians: Gaussians, params: BandedParams, layout: BandedLayout, num_shares: Array):
        gaussians, inner = self.inner.share(gaussians, params.inner, layout.inner, num_shares)
        return gaussians, params._replace(inner=inner)

    def opacities(self, gaussians: Gaussians, params: BandedParams, layout: BandedLayout) -> Array:
        return self.inner.opacities(gaussians, params.inner, layout.inner)

    def limit_opacities(self, gaussians: Gaussians, params: BandedParams, layout: BandedLayout, most: Array):
        gaussians, inner = self.inner.limit_opacities(gaussians, params.inner, layout.inner, most)
        return gaussians, params._replace(inner=inner)

    def first_rows(self, params: BandedParams, layout: BandedLayout, num: int) -> tuple[BandedParams, BandedLayout]:
        bands, owners = first_bands(params.bands, layout.bands, num)
        inner, inner_layout = self.inner.first_rows(params.inner, layout.inner, num)
        return BandedParams(bands, inner), BandedLayout(owners, inner_layout)

    def sh(self, gaussians: Gaussians, params: BandedParams, layout: BandedLayout) -> np.ndarray:
        return dense_sh(np.asarray(gaussians.sh), params.bands, layout.bands)

    def with_sh(self, sh: np.ndarray, params: BandedParams, layout: BandedLayout) -> BandedParams:
        bands, _ = split_sh(sh, layout.bands.degrees, layout.bands.base_degree)
        return params._replace(bands=bands)

    def textures(self, params: BandedParams, layout: BandedLayout) -> tuple[Textures, AtlasLayout] | None:
        return self.inner.textures(params.inner, layout.inner)

    def with_textures(self, params: BandedParams, layout: BandedLayout, textures: Textures, atlas: AtlasLayout):
        inner, inner_layout = self.inner.with_textures(params.inner, layout.inner, textures, atlas)
        return params._replace(inner=inner), layout._replace(inner=inner_layout)

    # Files.

    def arrays(self, params: BandedParams, layout: BandedLayout) -> dict[str, np.ndarray]:
        """`degrees` [N], `base_degree`, of each band above that `band_l` [M, 2l + 1, 3] in the Gaussians' order, and
        what else is shown, as `inner.NAME`."""
        arrays = {"degrees": layout.bands.degrees.astype(np.uint8)}
        arrays["base_degree"] = np.asarray(layout.bands.base_degree, np.uint8)
        tables = zip(layout.bands.bands, params.bands.tables, layout.bands.owners, strict=True)
        for band, table, owners in tables:
            arrays[f"band_{band}"] = np.asarray(table)[np.asarray(owners) < layout.num]
        inner = self.inner.arrays(params.inner, layout.inner)
        return arrays | {f"inner.{name}": array for name, array in inner.items()}

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[BandedParams, BandedLayout]:
        missing = [name for name in ("degrees", "base_degree") if name not in arrays]
        if missing:
            raise ValueError(f"the array {missing[0]} of {type(self).__name__} is missing")
        degrees, base = np.asarray(arrays["degrees"]), int(arrays["base_degree"])
        if degrees.ndim != 1 or not np.issubdtype(degrees.dtype, np.integer) or not 0 <= base <= 3:
            raise ValueError(f"degrees must be integers [N] above a base degree in 0..3; got {degrees.shape}, {base}")
        bands, layout = allocate_bands(degrees.astype(np.int64), base)
        tables = []
        for band, table in zip(layout.bands, bands.tables, strict=True):
            found = arrays.get(f"band_{band}")
            wanted = (int(np.count_nonzero(degrees >= band)), 2 * band + 1, 3)
            if found is None or found.shape != wanted:
                raise ValueError(f"band_{band} must be {list(wanted)}; got {None if found is None else found.shape}")
            filled = np.zeros(table.shape, found.dtype)
            filled[: len(found)] = found
            tables.append(jnp.asarray(filled))
        inner = {name.removeprefix("inner."): array for name, array in arrays.items() if name.startswith("inner.")}
        params, inner_layout = self.inner.from_arrays(inner)
        return BandedParams(Bands(tuple(tables)), params), BandedLayout(layout, inner_layout)
