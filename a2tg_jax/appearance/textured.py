"""Appearance of A²TG: each splat has its own texture, looked up bilinearly at (u, v).

This module defines where (u, v) lies in a texture, and how its RGB and alpha change the splat. `texture` stores
textures, `core.bilinear` interpolates them, `appearance.rule` is the interface. The renderer sees all textures one
after the other as texels [T, 4], each row by row.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.bucketed import Bucketed
from a2tg_jax.appearance.options import TextureOptions
from a2tg_jax.appearance.rule import AppearanceRule, Factor, Residual, gaussian_cutoff
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import within
from a2tg_jax.core.pytree import pytree
from a2tg_jax.texture import NEUTRAL_TEXEL, AtlasLayout, Textures, allocate_textures, nearest_places

EXTENT = 3.0
"""Half the side of a texture, in standard deviations."""


@pytree
class TexturedRule(AppearanceRule):
    """Appearance rule: RGB residual and alpha factor from each splat's own texture."""

    texels: Array
    """[T, 4] texels of all textures."""
    regions: TextureRegion
    """[N] places of the textures, Tv × Tu."""
    peaks: Array
    """[N] largest alpha factor of each splat; only for bounds, without gradient."""
    options: TextureOptions = dataclasses.field(metadata={"static": True})

    empty = NEUTRAL_TEXEL

    @property
    def max_alpha(self) -> float:  # type: ignore[override]
        return self.options.max_alpha

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        width, height = region.width.astype(u.dtype), region.height.astype(v.dtype)
        return texel_coordinates(u, width, self.options.uv), texel_coordinates(v, height, self.options.uv)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        red, green, blue, alpha = values
        if self.options.outside == "identity":
            is_inside = (jnp.abs(u) <= EXTENT) & (jnp.abs(v) <= EXTENT)
            red, green, blue = (jnp.where(is_inside, channel, 0.0) for channel in (red, green, blue))
            alpha = jnp.where(is_inside, alpha, 1.0)
        return (red, green, blue), alpha

    def cutoff(self, opacities: Array) -> Array:
        return gaussian_cutoff(opacities * self.peaks)


def textured_rule(textures: Textures, layout: AtlasLayout, options: TextureOptions) -> TexturedRule:
    """Return the rule of textures and their layout. Traceable; differentiable in the texels.

    An empty texture has a region of no texels and changes nothing. Buckets and rows out of range are clamped.
    """
    layout = nearest_places(textures, layout)
    textures = shown_textures(textures, layout, options)
    resolutions = [bucket.shape[1:3] for bucket in textures.buckets]
    areas = [height * width for height, width in resolutions]
    capacities = [bucket.shape[0] for bucket in textures.buckets]
    starts = np.cumsum([0] + [capacity * area for capacity, area in zip(capacities, areas, strict=True)])[:-1]
    bucket_starts, bucket_areas = jnp.asarray(starts, jnp.int32), jnp.asarray(areas, jnp.int32)
    sizes = jnp.asarray(resolutions, jnp.int32)[layout.bucket]
    peaks = jnp.stack([_padded_peaks(bucket, max(capacities)) for bucket in textures.buckets])
    peaks = jax.lax.stop_gradient(peaks[layout.bucket, layout.row])
    offsets = bucket_starts[layout.bucket] + layout.row * bucket_areas[layout.bucket]
    texels = [bucket.reshape(-1, 4) for bucket in textures.buckets if bucket.size]
    none = jnp.asarray([NEUTRAL_TEXEL], textures.buckets[0].dtype)
    return TexturedRule(
        texels=jnp.concatenate(texels or [none]),
        regions=TextureRegion(offsets, sizes[:, 0], sizes[:, 1]),
        peaks=jnp.maximum(peaks, 1.0) if options.outside == "identity" else peaks,
        options=options,
    )


def shown_textures(textures: Textures, layout: AtlasLayout, options: TextureOptions) -> Textures:
    """Return RGB residuals and alpha factors as they are shown, from the trained texels."""
    if options.rgb == "signed" and options.alpha == "projected":
        return textures
    divisor = _largest_alpha(textures, layout) + 1e-6 if options.alpha == "global-maximum" else None

    def shown(texels: Array) -> Array:
        rgb, alpha = texels[..., :3], texels[..., 3:]
        rgb = within(rgb, 0.0, 1.0) if options.rgb == "unit" else rgb
        alpha = alpha if divisor is None else within(alpha / divisor, 0.0, 1.0)
        return jnp.concatenate([rgb, alpha], axis=-1)

    result: Textures = jax.tree.map(shown, textures)
    return result


def _largest_alpha(textures: Textures, layout: AtlasLayout) -> Array:
    """Return the largest alpha of all texels without padding, or 1 if all textures are empty.

    Several equal maxima share the gradient.
    """
    alphas = [jnp.ones(1, textures.buckets[0].dtype)] if not any(bucket.size for bucket in textures.buckets) else []
    for index, bucket in enumerate(textures.buckets):
        num_used = jnp.sum(layout.bucket == index, dtype=jnp.int32)
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


class TexelRates(NamedTuple):
    """Learning rates of texels by the size of their texture."""

    larger: Any
    """Rate of textures of more than one texel."""
    single: Any
    """Rate of textures of one texel, which only change the colour and opacity of their Gaussian."""


@dataclasses.dataclass(frozen=True)
class Textured(Bucketed):
    """A texture for each splat: `params` are `Textures`, `layout` is their `AtlasLayout`."""

    start: tuple[int, int] = (1, 1)
    """Initial (Tv, Tu) of every texture, each 1 to 16; (0, 0): no textures until they grow."""
    options: TextureOptions = TextureOptions()  # noqa: RUF009 - frozen
    """Conventions of the textures."""

    @property
    def max_alpha(self) -> float:  # type: ignore[override]
        return self.options.max_alpha

    @property
    def is_portable(self) -> bool:
        return type(self) is Textured

    @property
    def is_linear(self) -> bool:
        return self.options.rgb == "signed"

    @property
    def texture_options(self) -> TextureOptions:
        return self.options

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[Textures, AtlasLayout]:
        sizes = np.broadcast_to(np.asarray(self.start, np.int64), (gaussians.num, 2))
        return allocate_textures(sizes, rgb=self.options.initial_rgb, dtype=gaussians.means.dtype)

    def rule(self, params: Textures, layout: AtlasLayout) -> AppearanceRule:
        return textured_rule(params, layout, self.options)

    def project(self, params: Textures) -> Textures:
        return project_texels(params, self.options)

    def rates(self, rate: Any, params: Textures) -> Any:
        """Return one rate for all texels, or those of `TexelRates`."""
        if not isinstance(rate, TexelRates):
            return rate
        is_single = [bucket.shape[1:3] == (1, 1) for bucket in params.buckets]
        return Textures(tuple(rate.single if single else rate.larger for single in is_single))

    def num_floats(self, layout: AtlasLayout, num: int) -> int:
        return 4 * layout.count_texels(num)


def project_texels(textures: Textures, options: TextureOptions) -> Textures:
    """Return textures with alpha factors clamped to [0, 1], and RGB too if it is unsigned.

    Alpha that is divided by its maximum has no upper bound. What `shown_textures` would clip is clipped here as well,
    which changes no image: beyond the bounds, where gradients are 0, texels would stay for ever.
    """
    most_alpha = jnp.inf if options.alpha == "global-maximum" else 1.0
    least, most = (0.0, 1.0) if options.rgb == "unit" else (-jnp.inf, jnp.inf)

    def projected(texels: Array) -> Array:
        bounds = (jnp.asarray([rgb] * 3 + [alpha], texels.dtype) for rgb, alpha in ((least, 0.0), (most, most_alpha)))
        return jnp.clip(texels, *(bound[None, None, None] for bound in bounds))

    result: Textures = jax.tree.map(projected, textures)
    return result
