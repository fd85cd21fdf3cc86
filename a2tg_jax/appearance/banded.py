"""Spherical harmonics with a degree per Gaussian, on top of any other appearance."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.around import AppearanceAround
from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.plain import Plain
from a2tg_jax.appearance.rule import RuleAround
from a2tg_jax.appearance.sh_bands import (
    BandLayout,
    Bands,
    allocate_bands,
    band_colors,
    clear_bands,
    first_bands,
    gather_bands,
    join_bands,
    take_bands,
)
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import pytree


class BandedParams(NamedTuple):
    """Coefficients beyond the base degree, and the parameters of the inner appearance."""

    bands: Bands
    inner: Any


class BandedLayout(NamedTuple):
    """Owners of the coefficients, and the layout of the inner appearance."""

    bands: BandLayout
    inner: Any

    @property
    def num(self) -> int:
        """Number of Gaussians."""
        return self.bands.num


class BandedRates(NamedTuple):
    """Learning rates of the coefficients and of the inner appearance."""

    bands: Any
    inner: Any = 0.0


@pytree
class BandedRule(RuleAround):
    """Another rule, with more spherical harmonics for some Gaussians."""

    bands: Bands
    layout: BandLayout

    def own_color_sums(self, gaussians: Gaussians, camera: Camera, degree: Any) -> Array:
        own = self.inner.own_color_sums(gaussians, camera, degree)
        return own + band_colors(self.bands, self.layout, gaussians.means, camera.center, degree)


@dataclasses.dataclass(frozen=True)
class Banded(AppearanceAround):
    """Appearance with view dependence of a degree per Gaussian on top of another one."""

    inner: Appearance = dataclasses.field(default_factory=Plain)

    @property
    def is_portable(self) -> bool:
        return type(self) is Banded and self.inner.is_portable and not self.inner.has_degrees

    @property
    def has_degrees(self) -> bool:
        return True

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[BandedParams, BandedLayout]:
        degrees = np.full(gaussians.num, gaussians.sh_degree)
        bands, owners = allocate_bands(degrees, gaussians.sh_degree, gaussians.means.dtype)
        params, layout = self.inner.allocate(key, gaussians)
        return BandedParams(bands, params), BandedLayout(owners, layout)

    def rule(self, params: BandedParams, layout: BandedLayout) -> BandedRule:
        return BandedRule(self.inner.rule(params.inner, layout.inner), params.bands, layout.bands)

    def rates(self, rate: Any, params: BandedParams) -> BandedParams:
        """Return the rates of `BandedRates`."""
        return BandedParams(rate.bands, self.inner.rates(rate.inner, params.inner))

    def num_floats(self, layout: BandedLayout, num: int) -> int:
        return layout.bands.count_floats(num) + self.inner.num_floats(layout.inner, num)

    def gather(self, params: BandedParams, layout: BandedLayout, rows: Array) -> BandedParams:
        bands = gather_bands(params.bands, layout.bands, rows)
        gathered: BandedParams = super().gather(params, layout, rows)._replace(bands=bands)
        return gathered

    def clear(self, params: BandedParams, layout: BandedLayout, is_cleared: Array) -> BandedParams:
        bands = clear_bands(params.bands, layout.bands, is_cleared)
        cleared: BandedParams = super().clear(params, layout, is_cleared)._replace(bands=bands)
        return cleared

    def first_rows(self, params: BandedParams, layout: BandedLayout, num: int) -> tuple[BandedParams, BandedLayout]:
        bands, owners = first_bands(params.bands, layout.bands, num)
        params, layout = super().first_rows(params, layout, num)
        return params._replace(bands=bands), layout._replace(bands=owners)

    def take_rows(
        self, params: BandedParams, layout: BandedLayout, rows: np.ndarray
    ) -> tuple[BandedParams, BandedLayout]:
        bands, owners = take_bands(params.bands, layout.bands, rows)
        params, layout = super().take_rows(params, layout, rows)
        return params._replace(bands=bands), layout._replace(bands=owners)

    def joined(self, parts: Sequence[tuple[BandedParams, BandedLayout]]) -> tuple[BandedParams, BandedLayout]:
        bands, owners = join_bands([(params.bands, layout.bands) for params, layout in parts])
        params, layout = super().joined(parts)
        return params._replace(bands=bands), layout._replace(bands=owners)

    def bands(self, params: BandedParams, layout: BandedLayout) -> tuple[Bands, BandLayout]:
        return params.bands, layout.bands

    def with_bands(
        self, params: BandedParams, layout: BandedLayout, bands: Bands, owners: BandLayout
    ) -> tuple[BandedParams, BandedLayout]:
        return params._replace(bands=bands), layout._replace(bands=owners)

    def check(self, params: BandedParams, layout: BandedLayout, gaussians: Gaussians) -> None:
        own, base = gaussians.sh_degree, layout.bands.base_degree
        if own != base:
            raise ValueError(f"Banded has bands above degree {base}, but the Gaussians have degree {own}")
        if layout.bands.num != gaussians.num:
            raise ValueError(f"Banded has {layout.bands.num} degrees, but there are {gaussians.num} Gaussians")
        super().check(params, layout, gaussians)

    def arrays(self, params: BandedParams, layout: BandedLayout) -> dict[str, np.ndarray]:
        """Return `degrees` [N], `base_degree`, each band above it, and the inner appearance's arrays as `inner.NAME`.

        Band l is `band_l` [M, 2l + 1, 3], in the order of the Gaussians.
        """
        arrays = {"degrees": layout.bands.degrees.astype(np.uint8)}
        arrays["base_degree"] = np.asarray(layout.bands.base_degree, np.uint8)
        tables = zip(layout.bands.bands, params.bands.tables, layout.bands.owners, strict=True)
        for band, table, owners in tables:
            arrays[f"band_{band}"] = np.asarray(table)[np.asarray(owners) < layout.num]
        return arrays | super().arrays(params, layout)

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
        params, inner_layout = self.inner_from_arrays(arrays)
        return BandedParams(Bands(tuple(tables)), params), BandedLayout(layout, inner_layout)
