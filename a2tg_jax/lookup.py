"""The appearance rule of A²TG: a texture of its own for each splat, looked up bilinearly at (u, v).

B splats of a block, P pixels of a tile. A splat's texels are handed over as a window [K, 4] of the flattened atlas,
K the texels of the largest texture; entries past its own Tv·Tu belong to others and get no weight.
"""

import dataclasses
import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import FEW, add_at, gaussian_cutoff
from a2tg_jax.numerics import spread
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


class TextureRows(NamedTuple):
    """The textures of a block's splats."""

    texels: Array
    """[B, K, 4] windows into the atlas."""
    sizes: Array
    """[B, 2] (Tv, Tu)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TexturedAppearance:
    """An appearance rule: RGB residual and alpha factor from each splat's own texture."""

    params: Array
    """[texels + K, 4] the flattened atlas."""
    offsets: Array
    """[N] first texel of each splat."""
    sizes: Array
    """[N, 2] (Tv, Tu)."""
    peaks: Array
    """[N] the largest alpha factor of each splat; bounds only, without gradient."""
    window: int = dataclasses.field(metadata={"static": True})
    """K."""
    options: TextureOptions = dataclasses.field(metadata={"static": True})
    is_vectorised: bool = dataclasses.field(metadata={"static": True})
    """Gather the four texels around each pixel, which suits GPUs; else branch by texture size, which suits CPUs."""

    def rows(self, params: Array, ids: Array) -> TextureRows:
        offsets = self.offsets[ids]
        if ids.shape[0] > FEW:
            places = offsets[:, None] + jnp.arange(self.window, dtype=jnp.int32)[None, :]
            return TextureRows(params[places], self.sizes[ids])
        starts = [(offset, jnp.zeros_like(offset)) for offset in offsets]
        windows = [jax.lax.dynamic_slice(params, start, (self.window, 4)) for start in starts]
        return TextureRows(jnp.stack(windows), self.sizes[ids])

    def sample(self, rows: TextureRows, u: Array, v: Array):
        texels, sizes = rows
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        if self.options.rgb == "unit":
            texels = jnp.concatenate([jnp.clip(texels[..., :3], 0, 1), texels[..., 3:]], -1)
        x = texel_coordinates(u, sizes[:, 1:2].astype(u.dtype), self.options.uv)
        y = texel_coordinates(v, sizes[:, 0:1].astype(u.dtype), self.options.uv)
        lookup = _bilinear_gather if self.is_vectorised else _bilinear_by_size
        red, green, blue, alpha = lookup(texels, sizes, x, y)
        if self.options.outside == "identity":
            is_inside = (jnp.abs(u) <= EXTENT) & (jnp.abs(v) <= EXTENT)
            red, green, blue = (jnp.where(is_inside, channel, 0.0) for channel in (red, green, blue))
            alpha = jnp.where(is_inside, alpha, 1.0)
        return (red, green, blue), alpha

    def falloff(self, rho: Array) -> Array:
        return jnp.exp(-0.5 * rho)

    def add_rows(self, total: Array, ids: Array, rows: TextureRows) -> Array:
        offsets = self.offsets[ids]
        if ids.shape[0] > FEW:
            places = offsets[:, None] + jnp.arange(self.window, dtype=jnp.int32)[None, :]
            return add_at(total, places.reshape(-1), rows.texels.reshape(-1, 4))
        for position in range(ids.shape[0]):
            at = (offsets[position], jnp.zeros_like(offsets[position]))
            old = jax.lax.dynamic_slice(total, at, (self.window, 4))
            total = jax.lax.dynamic_update_slice(total, old + rows.texels[position], at)
        return total

    def cutoff(self, params: Array, opacities: Array) -> Array:
        return gaussian_cutoff(opacities * self.peaks)


def textured_appearance(
    textures: Textures, layout: AtlasLayout, options: TextureOptions, *, is_vectorised: bool
) -> TexturedAppearance:
    """The rule that shows `textures`, laid out as `layout` says. Traceable; differentiable in the texels."""
    areas = [height * width for height, width in layout.resolutions]
    window = max(areas, default=1)
    capacities = [bucket.shape[0] for bucket in textures.buckets]
    starts = np.cumsum([0] + [capacity * area for capacity, area in zip(capacities, areas, strict=True)])[:-1]
    flat = [bucket.reshape(-1, 4) for bucket in textures.buckets]
    padding = jnp.zeros((window, 4), flat[0].dtype)
    bucket_starts, bucket_areas = jnp.asarray(starts, jnp.int32), jnp.asarray(areas, jnp.int32)
    peaks = jnp.stack([_padded_peaks(bucket, max(capacities)) for bucket in textures.buckets])
    peaks = jax.lax.stop_gradient(peaks[layout.bucket, layout.row])
    return TexturedAppearance(
        params=jnp.concatenate([*flat, padding]),
        offsets=bucket_starts[layout.bucket] + layout.row * bucket_areas[layout.bucket],
        sizes=jnp.asarray(layout.resolutions, jnp.int32)[layout.bucket],
        peaks=jnp.maximum(peaks, 1.0) if options.outside == "identity" else peaks,
        window=window,
        options=options,
        is_vectorised=is_vectorised,
    )


def _padded_peaks(bucket: Array, length: int) -> Array:
    """[length] largest alpha of each texture of a bucket, zeros past its capacity."""
    peaks = jnp.max(bucket[..., 3], axis=(1, 2))
    return jnp.pad(peaks, (0, length - peaks.shape[0]))


def texel_coordinates(u: Array, size: Array, convention: str) -> Array:
    """Where u, in standard deviations, lies among the `size` texels of its axis, clamped to [0, size − 1]."""
    unit = (u / EXTENT + 1) / 2
    x = unit * (size - 1) if convention == "align-corners" else unit * size - 0.5
    return jnp.clip(x, 0.0, size - 1)


def _bilinear_gather(texels: Array, sizes: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """The four channels [B, P] at texel coordinates x, y [B, P]: four gathered texels a pixel."""
    columns, rows = sizes[:, 1:2], sizes[:, 0:1]
    left, top = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    right, bottom = jnp.minimum(left + 1, columns - 1), jnp.minimum(top + 1, rows - 1)
    fx, fy = x - left.astype(x.dtype), y - top.astype(y.dtype)

    def texel(row, column):
        return jnp.take_along_axis(texels, (row * columns + column)[..., None], axis=1)

    fx, fy = fx[..., None], fy[..., None]
    above = texel(top, left) * (1 - fx) + texel(top, right) * fx
    below = texel(bottom, left) * (1 - fx) + texel(bottom, right) * fx
    red, green, blue, alpha = jnp.moveaxis(above * (1 - fy) + below * fy, -1, 0)
    return red, green, blue, alpha


def _bilinear_by_size(texels: Array, sizes: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """As `_bilinear_gather`, splat by splat, each at the cost of its own texture's size."""
    channels = jax.lax.map(lambda splat: _lookup_one(*splat), (texels, sizes, x, y))
    red, green, blue, alpha = jnp.moveaxis(channels, 1, 0)
    return red, green, blue, alpha


def _size_classes(window: int) -> list[int]:
    """Numbers of texels with a branch of their own: 1, 4, 16, 64, 256 up to the window."""
    return [4**power for power in range(5) if 4**power < 4 * window]


@jax.custom_vjp
def _lookup_one(texels: Array, size: Array, x: Array, y: Array) -> Array:
    """The channels [4, P] of one splat, from texels [K, 4]. The gradient recomputes the branch it needs: kept
    intermediates would be those of all branches together."""
    return jax.lax.switch(_size_class(texels, size), _branches(texels), texels, size, x, y)


def _lookup_one_fwd(texels, size, x, y):
    return _lookup_one(texels, size, x, y), (texels, size, x, y)


def _lookup_one_bwd(residuals, cotangent):
    texels, size, x, y = residuals

    def pull_back(branch, texels, size, x, y, cotangent):
        return jax.vjp(lambda texels, x, y: branch(texels, size, x, y), texels, x, y)[1](cotangent)

    branches = [functools.partial(pull_back, branch) for branch in _branches(texels)]
    d_texels, d_x, d_y = jax.lax.switch(_size_class(texels, size), branches, texels, size, x, y, cotangent)
    return d_texels, None, d_x, d_y


_lookup_one.defvjp(_lookup_one_fwd, _lookup_one_bwd)


def _size_class(texels: Array, size: Array) -> Array:
    num_texels = size[0] * size[1]
    thresholds = jnp.asarray(_size_classes(texels.shape[0])[:-1], jnp.int32)
    return jnp.sum((num_texels > thresholds).astype(jnp.int32))


def _branches(texels: Array):
    classes = _size_classes(texels.shape[0])
    return [functools.partial(_single if area == 1 else _hats, min(area, texels.shape[0])) for area in classes]


def _single(_, texels: Array, size: Array, x: Array, y: Array) -> Array:
    """A 1×1 texture: one texel everywhere."""
    return spread(texels[0], x.shape[0])


def _hats(area: int, texels: Array, size: Array, x: Array, y: Array) -> Array:
    """Σ_k hat(x − column_k)·hat(y − row_k)·texel_k with hat(d) = max(0, 1 − |d|): bilinear without a gather."""
    # In floats, where these small quotients are exact: integer division would cost more than all the rest.
    index, columns = jnp.arange(area, dtype=x.dtype), size[1].astype(x.dtype)
    row = jnp.floor((index + 0.5) / columns)
    column = index - row * columns
    row = jnp.where(row < size[0].astype(x.dtype), row, -2.0)
    weights = _hat(x[None, :] - column[:, None]) * _hat(y[None, :] - row[:, None])
    return _weigh(texels[:area], weights)


@jax.custom_vjp
def _weigh(texels: Array, weights: Array) -> Array:
    """Channels [4, P] = texelsᵀ [4, K]·weights [K, P], written as products with vectors, which CPUs vectorise."""
    return jnp.stack([jnp.dot(texels[:, channel], weights) for channel in range(4)])


def _weigh_bwd(residuals, cotangent):
    texels, weights = residuals
    d_texels = jnp.stack([jnp.dot(weights, cotangent[channel]) for channel in range(4)], axis=1)
    d_weights = sum(texels[:, channel, None] * cotangent[channel][None, :] for channel in range(4))
    return d_texels, d_weights


_weigh.defvjp(lambda texels, weights: (_weigh(texels, weights), (texels, weights)), _weigh_bwd)


def _hat(distance: Array) -> Array:
    return jnp.maximum(1 - jnp.abs(distance), 0.0)
