"""The appearance rule of A²TG: a texture of its own for each splat, looked up bilinearly at (u, v).

All textures lie one after the other in a table [texels, 4], row by row; a splat's row is (offset, Tv, Tu).
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Values, gaussian_cutoff
from a2tg_jax.texture import AtlasLayout, Textures

EXTENT = 3.0
"""Half the side of a texture, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class TextureOptions:
    """How textures are read. The defaults are the paper's text; `official()` is the authors' program."""

    uv: Literal["texel-centre", "align-corners"] = "texel-centre"
    """Texel centres at half-texel offsets over ±3σ, or the outer ones at ±3σ exactly."""
    outside: Literal["clamp", "identity"] = "clamp"
    """Beyond ±3σ: the edge texel goes on, or the texture shows nothing (RGB 0, alpha 1)."""
    rgb: Literal["signed", "unit"] = "signed"
    """RGB residuals of either sign, or clipped to [0, 1]."""
    uv_gradient: bool = True
    """Whether the lookup position carries gradients into the geometry."""
    initial_rgb: float = 0.0
    """RGB of new textures."""

    @staticmethod
    def official() -> "TextureOptions":
        """The conventions of the authors' own program."""
        return TextureOptions("align-corners", "identity", "unit", uv_gradient=False, initial_rgb=0.1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TexturedAppearance:
    """An appearance rule: RGB residual and alpha factor from each splat's own texture."""

    params: Array
    """[texels, 4] all textures."""
    rows: tuple[Array, Array, Array]
    """[N] first texel of each splat, Tv and Tu."""
    peaks: Array
    """[N] the largest alpha factor of each splat; bounds only, without gradient."""
    options: TextureOptions = dataclasses.field(metadata={"static": True})

    def lookup(self, row, u: Array, v: Array) -> tuple[Array, Array, Array, Array]:
        """The texels above left, above right, below left and below right of (u, v)."""
        offset, height, width = row
        left, top = (_cell(x) for x in self._texel_coordinates(row, u, v))
        right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
        above, below = offset + top * width, offset + bottom * width
        return above + left, above + right, below + left, below + right

    def shade(self, row, values: Values, u: Array, v: Array):
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        x, y = self._texel_coordinates(row, u, v)
        fx, fy = x - _cell(x).astype(x.dtype), y - _cell(y).astype(y.dtype)
        above_left, above_right, below_left, below_right = [self._displayed(texel) for texel in values]
        corners = zip(above_left, above_right, below_left, below_right, strict=True)
        red, green, blue, alpha = (_mix(_mix(a, b, fx), _mix(c, d, fx), fy) for a, b, c, d in corners)
        if self.options.outside == "identity":
            is_inside = (jnp.abs(u) <= EXTENT) & (jnp.abs(v) <= EXTENT)
            red, green, blue = (jnp.where(is_inside, channel, 0.0) for channel in (red, green, blue))
            alpha = jnp.where(is_inside, alpha, 1.0)
        return (red, green, blue), alpha

    def falloff(self, rho: Array) -> Array:
        return jnp.exp(-0.5 * rho)

    def cutoff(self, opacities: Array) -> Array:
        return gaussian_cutoff(opacities * self.peaks)

    @property
    def num_bytes(self) -> int:
        _, height, width = self.rows
        return 16 * int(np.sum(np.asarray(height, np.int64) * np.asarray(width, np.int64)))

    def _texel_coordinates(self, row, u: Array, v: Array) -> tuple[Array, Array]:
        _, height, width = row
        size_u, size_v = width.astype(u.dtype), height.astype(v.dtype)
        return texel_coordinates(u, size_u, self.options.uv), texel_coordinates(v, size_v, self.options.uv)

    def _displayed(self, texel: tuple[Array, ...]) -> tuple[Array, ...]:
        if self.options.rgb == "signed":
            return texel
        return (*(jnp.clip(channel, 0.0, 1.0) for channel in texel[:3]), texel[3])


def textured_appearance(textures: Textures, layout: AtlasLayout, options: TextureOptions) -> TexturedAppearance:
    """The rule that shows `textures`, laid out as `layout` says. Traceable; differentiable in the texels."""
    areas = [height * width for height, width in layout.resolutions]
    capacities = [bucket.shape[0] for bucket in textures.buckets]
    starts = np.cumsum([0] + [capacity * area for capacity, area in zip(capacities, areas, strict=True)])[:-1]
    bucket_starts, bucket_areas = jnp.asarray(starts, jnp.int32), jnp.asarray(areas, jnp.int32)
    sizes = jnp.asarray(layout.resolutions, jnp.int32)[layout.bucket]
    peaks = jnp.stack([_padded_peaks(bucket, max(capacities)) for bucket in textures.buckets])
    peaks = jax.lax.stop_gradient(peaks[layout.bucket, layout.row])
    offsets = bucket_starts[layout.bucket] + layout.row * bucket_areas[layout.bucket]
    return TexturedAppearance(
        params=jnp.concatenate([bucket.reshape(-1, 4) for bucket in textures.buckets]),
        rows=(offsets, sizes[:, 0], sizes[:, 1]),
        peaks=jnp.maximum(peaks, 1.0) if options.outside == "identity" else peaks,
        options=options,
    )


def _padded_peaks(bucket: Array, length: int) -> Array:
    """[length] largest alpha of each texture of a bucket, zeros past its capacity."""
    peaks = jnp.max(bucket[..., 3], axis=(1, 2))
    return jnp.pad(peaks, (0, length - peaks.shape[0]))


def texel_coordinates(u: Array, size: Array, convention: str) -> Array:
    """Where u, in standard deviations, lies among the `size` texels of its axis, clamped to [0, size − 1]."""
    unit = (u * (1 / EXTENT) + 1) * 0.5
    x = unit * (size - 1) if convention == "align-corners" else unit * size - 0.5
    return jnp.clip(x, 0.0, size - 1)


def _cell(x: Array) -> Array:
    """The texel left of, or above, a texel coordinate."""
    return jnp.floor(x).astype(jnp.int32)


def _mix(a: Array, b: Array, fraction: Array) -> Array:
    return a + (b - a) * fraction
