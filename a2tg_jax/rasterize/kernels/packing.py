"""Splats and their texture regions as plain arrays for kernels, and cotangents back from such arrays."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize.splats import CompositingSettings, Splats, num_numbers
from a2tg_jax.rasterize.tiles import TileLists


def pack_inputs(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None, cutoff: Array,
    lists: TileLists,
) -> tuple[Array, ...]:  # fmt: skip
    """Pack what kernels read: ids, starts, splats with the cutoff, regions, texels, and (columns, width, height).

    Kernels follow these indices without checking them. Ids and starts are clamped here, and regions by the compositor
    (`bilinear.within_texels`), so that no list and no region, whatever it holds, makes them read or write elsewhere.
    Rays of pixels are packed apart (`native.composite`).
    """
    num, capacity = splats.M.shape[0], lists.ids.shape[0]
    packed = pack_splats(splats, settings.kernel.has_geometry, cutoff).astype(splats.M.dtype)
    size = jnp.asarray([settings.grid.columns, settings.grid.width, lists.height_in(settings.grid)], jnp.int32)
    # Threads divide the tiles by their starts, which must ascend. Without splats no id is valid: all lists are empty.
    starts = jax.lax.cummax(jnp.clip(lists.starts, 0, capacity if num else 0))
    ids = jnp.clip(lists.ids, 0, max(num - 1, 0))
    return ids, starts, packed, pack_regions(regions), texels.astype(splats.M.dtype), size


def pack_splats(splats: Splats, has_geometry: bool, *more: Array) -> Array:
    """Pack splats as [N, S], one per row in the order of `rasterize.pixel.Splat`, followed by further columns [N]."""
    columns = [splats.M.reshape(-1, 9), splats.opacities[:, None], splats.colors]
    columns += [splats.normals] if has_geometry else []
    return jnp.concatenate([*columns, splats.numbers, *(column[:, None] for column in more)], axis=1)


def unpack_splats(packed: Array, like: Splats, has_geometry: bool) -> Splats:
    """Unpack cotangents [N, S] as those of splats."""
    num_colors = like.colors.shape[1]
    normal, first = 10 + num_colors, num_numbers(has_geometry, num_colors)
    return Splats(
        M=packed[:, :9].reshape(-1, 3, 3).astype(like.M.dtype),
        opacities=packed[:, 9].astype(like.opacities.dtype),
        colors=packed[:, 10:normal].astype(like.colors.dtype),
        normals=packed[:, normal:first].astype(like.normals.dtype) if has_geometry else jnp.zeros_like(like.normals),
        numbers=packed[:, first : first + like.numbers.shape[1]].astype(like.numbers.dtype),
    )


def split_image(image: Array) -> tuple[Array, Array]:
    """Split a kernel's image [tiles, D + 1, P] into channels [tiles, D, P] and transmittance [tiles, P]."""
    return image[:, :-1], image[:, -1]


def unpack_gradients(
    settings: CompositingSettings, found: Sequence[Array], splats: Splats, texels: Array, probe: Array
) -> tuple[Splats, Array, Array]:
    """Unpack a kernel's gradients, of `KernelSpec.gradient_shapes`, as those of splats, texels and probe."""
    packed, d_texels, d_probe = found
    d_splats = unpack_splats(packed, splats, settings.kernel.has_geometry)
    d_probe = d_probe.astype(probe.dtype) if settings.kernel.statistic else jnp.zeros_like(probe)
    return d_splats, d_texels.astype(texels.dtype), d_probe


def pack_regions(regions: TextureRegion | None) -> Array:
    """Pack the `TextureRegion` of every splat as int32 [N, 3]; without textures [1, 0]."""
    if regions is None:
        return jnp.zeros((1, 0), jnp.int32)
    return jnp.stack(regions, axis=1).astype(jnp.int32)
