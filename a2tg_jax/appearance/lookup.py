"""Texture of A²TG: where (u, v) is in a splat's texture, and how its RGB and alpha change the splat.

`texture` stores textures, `core.bilinear` interpolates them. The renderer sees all of them one after the other as
texels [T, 4], each row by row.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.part import Factor, Part, Residual
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.checks import check_number
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import within
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.table import check_places
from a2tg_jax.texture import NEUTRAL_TEXEL, Textures, allocate_textures, check_textures

EXTENT = 3.0
"""Half the side of a texture, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class TextureOptions:
    """Conventions of textures. The defaults follow the paper's text, `official()` the authors' program."""

    uv: Literal["texel-centre", "align-corners"] = "texel-centre"
    """Place of the texels: centres at half-texel offsets over ±3σ, or the outer ones exactly at ±3σ."""
    outside: Literal["clamp", "identity"] = "clamp"
    """Texture beyond ±3σ: the edge texel continues, or nothing shows (RGB 0, alpha 1)."""
    rgb: Literal["signed", "unit"] = "signed"
    """RGB residuals of either sign, or clipped to [0, 1]."""
    uv_gradient: bool = True
    """Whether gradients flow through the lookup position into the geometry."""
    initial_rgb: float = 0.0
    """Initial RGB."""
    alpha: Literal["projected", "global-maximum"] = "projected"
    """Alpha factors clamped to [0, 1] after each update; or any numbers, divided by the largest of all textures and
    clipped to [0, 1] when shown."""
    max_alpha: float = 0.99
    """Upper limit of a splat's alpha."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        check_number("initial_rgb", self.initial_rgb, least=-1, most=1)
        check_number("max_alpha", self.max_alpha, least=1e-3, most=0.9999)

    @staticmethod
    def official() -> "TextureOptions":
        """Return the conventions of the authors' program."""
        return TextureOptions("align-corners", "identity", "unit", False, 0.1, "global-maximum", max_alpha=0.999)


class TexelRates(NamedTuple):
    """Learning rates of texels by the size of their texture."""

    larger: Any
    """Rate of textures of more than one texel."""
    single: Any
    """Rate of textures of one texel, which only change the colour and opacity of their Gaussian."""


@pytree
class Texture(Part):
    """RGB residual and alpha factor from a texture of each splat."""

    texels: Textures | None = None
    """Textures of N Gaussians; None until allocated."""
    start: tuple[int, int] = static(default=(1, 1))
    """Initial (Tv, Tu) of every texture, each 1 to 16; (0, 0): no textures until they grow."""
    options: TextureOptions = static(default=TextureOptions())
    """Conventions of the textures."""

    def allocate(self, gaussians: Gaussians) -> "Texture":
        sizes = np.broadcast_to(np.asarray(self.start, np.int64), (gaussians.num, 2))
        texels = allocate_textures(sizes, rgb=self.options.initial_rgb, dtype=gaussians.means.dtype)
        return dataclasses.replace(self, texels=texels)

    def check(self, gaussians: Gaussians) -> None:
        assert self.texels is not None
        check_textures(self.texels, gaussians.num)
        check_places(self.texels)

    def rates(self, rate: Any) -> Any:
        """Return one rate for all texels, or those of `TexelRates`."""
        if not isinstance(rate, TexelRates):
            return rate
        assert self.texels is not None
        is_single = [size == (1, 1) for size in self.texels.bucket_sizes]
        buckets = tuple(rate.single if single else rate.larger for single in is_single)
        return dataclasses.replace(self, texels=dataclasses.replace(self.texels, buckets=buckets))

    def project(self) -> "Texture":
        """Return textures with alpha factors clamped to [0, 1], and RGB too if it is unsigned.

        Alpha that is divided by its maximum has no upper bound. What `shown` would clip is clipped here as well, which
        changes no image: beyond the bounds, where gradients are 0, texels would stay for ever.
        """
        options = self.options
        most_alpha = jnp.inf if options.alpha == "global-maximum" else 1.0
        least, most = (0.0, 1.0) if options.rgb == "unit" else (-jnp.inf, jnp.inf)

        def projected(texels: Array) -> Array:
            bounds = (
                jnp.asarray([rgb] * 3 + [alpha], texels.dtype) for rgb, alpha in ((least, 0.0), (most, most_alpha))
            )
            return jnp.clip(texels, *(bound[None, None, None] for bound in bounds))

        assert self.texels is not None
        buckets = tuple(map(projected, self.texels.buckets))
        return dataclasses.replace(self, texels=dataclasses.replace(self.texels, buckets=buckets))

    def shown(self) -> Textures:
        """Return RGB residuals and alpha factors as they are shown, from the trained texels.

        Buckets and rows out of range are clamped.
        """
        assert self.texels is not None
        textures, options = self.texels.nearest_places(), self.options
        if options.rgb == "signed" and options.alpha == "projected":
            return textures
        divisor = _largest_alpha(textures) + 1e-6 if options.alpha == "global-maximum" else None

        def shown(texels: Array) -> Array:
            rgb, alpha = texels[..., :3], texels[..., 3:]
            rgb = within(rgb, 0.0, 1.0) if options.rgb == "unit" else rgb
            alpha = alpha if divisor is None else within(alpha / divisor, 0.0, 1.0)
            return jnp.concatenate([rgb, alpha], axis=-1)

        return dataclasses.replace(textures, buckets=tuple(map(shown, textures.buckets)))

    def atlas(self) -> tuple[Array, TextureRegion]:
        """Return all texels [T, 4], and the N places of the textures among them.

        An empty texture has a region of no texels and changes nothing.
        """
        textures = self.shown()
        areas = [height * width for height, width in textures.bucket_sizes]
        capacities = [bucket.shape[0] for bucket in textures.buckets]
        starts = np.cumsum([0] + [capacity * area for capacity, area in zip(capacities, areas, strict=True)])[:-1]
        bucket_starts, bucket_areas = jnp.asarray(starts, jnp.int32), jnp.asarray(areas, jnp.int32)
        sizes = jnp.asarray(textures.bucket_sizes, jnp.int32)[textures.bucket]
        offsets = bucket_starts[textures.bucket] + textures.row * bucket_areas[textures.bucket]
        texels = [bucket.reshape(-1, 4) for bucket in textures.buckets if bucket.size]
        none = jnp.asarray([NEUTRAL_TEXEL], textures.buckets[0].dtype)
        return jnp.concatenate(texels or [none]), TextureRegion(offsets, sizes[:, 0], sizes[:, 1])

    def peaks(self) -> Array:
        """Return the largest alpha factor [N] of each splat; only for bounds, without gradient."""
        textures = self.shown()
        capacities = [bucket.shape[0] for bucket in textures.buckets]
        peaks = jnp.stack([_padded_peaks(bucket, max(capacities)) for bucket in textures.buckets])
        peaks = jax.lax.stop_gradient(peaks[textures.bucket, textures.row])
        return jnp.maximum(peaks, 1.0) if self.options.outside == "identity" else peaks

    # Element-wise, without the texels

    def position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the lookup position (x, y) in texels, clamped to [0, width − 1] and [0, height − 1]."""
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        width, height = region.width.astype(u.dtype), region.height.astype(v.dtype)
        return texel_coordinates(u, width, self.options.uv), texel_coordinates(v, height, self.options.uv)

    def shade(self, values: tuple[Array, ...], u: Array, v: Array) -> tuple[Residual, Factor]:
        """Return colour residual and alpha factor at (u, v), from the four values looked up there."""
        red, green, blue, alpha = values
        if self.options.outside == "identity":
            is_inside = (jnp.abs(u) <= EXTENT) & (jnp.abs(v) <= EXTENT)
            red, green, blue = (jnp.where(is_inside, channel, 0.0) for channel in (red, green, blue))
            alpha = jnp.where(is_inside, alpha, 1.0)
        return (red, green, blue), alpha


def _largest_alpha(textures: Textures) -> Array:
    """Return the largest alpha of all texels without padding, or 1 if all textures are empty.

    Several equal maxima share the gradient.
    """
    alphas = [jnp.ones(1, textures.buckets[0].dtype)] if not any(bucket.size for bucket in textures.buckets) else []
    for index, bucket in enumerate(textures.buckets):
        num_used = jnp.sum(textures.bucket == index, dtype=jnp.int32)
        is_used = jnp.arange(bucket.shape[0], dtype=jnp.int32) < num_used
        alphas.append(jnp.where(is_used[:, None, None], bucket[..., 3], -jnp.inf).reshape(-1))
    return jnp.max(jnp.concatenate(alphas))


def _padded_peaks(bucket: Array, length: int) -> Array:
    """Return the largest alpha [length] of each texture of a bucket: 1 if empty, 0 past the capacity."""
    if not bucket.size:
        return jnp.ones(length, bucket.dtype)
    peaks = jnp.max(bucket[..., 3], axis=(1, 2))
    return jnp.pad(peaks, (0, length - peaks.shape[0]))


def texel_coordinates(u: Array, size: Array, convention: str) -> Array:
    """Return the position of u, in standard deviations, among the `size` texels of its axis, in [0, size − 1]."""
    unit = (u * (1 / EXTENT) + 1) * 0.5
    x = unit * (size - 1) if convention == "align-corners" else unit * size - 0.5
    return jnp.clip(x, 0.0, size - 1)
