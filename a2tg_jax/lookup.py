"""The appearance rule of A²TG: a texture of its own for each splat, looked up bilinearly at (u, v).

All textures lie one after the other in a table [texels, 4], row by row.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import gaussian_cutoff
from a2tg_jax.bilinear import Image
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
    images: Image
    """[N] each: where the textures lie, Tv × Tu."""
    peaks: Array
    """[N] the largest alpha factor of each splat; bounds only, without gradient."""
    options: TextureOptions = dataclasses.field(metadata={"static": True})

    def texel(self, image: Image, u: Array, v: Array) -> tuple[Array, Array]:
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        width, height = image.width.astype(u.dtype), image.height.astype(v.dtype)
        return texel_coordinates(u, width, self.options.uv), texel_coordinates(v, height, self.options.uv)

    def shade(self, values: tuple[Array, ...], u: Array, v: Array):
        red, green, blue, alpha = values
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
        heights, widths = (np.asarray(sizes, np.int64) for sizes in (self.images.height, self.images.width))
        return 16 * int(np.sum(heights * widths))


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
    texels = jnp.concatenate([bucket.reshape(-1, 4) for bucket in textures.buckets])
    if options.rgb == "unit":
        texels = jnp.concatenate([jnp.clip(texels[:, :3], 0.0, 1.0), texels[:, 3:]], axis=1)
    return TexturedAppearance(
        params=texels,
        images=Image(offsets, sizes[:, 0], sizes[:, 1]),
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
