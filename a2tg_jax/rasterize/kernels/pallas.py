"""Compositing by Pallas kernels on GPUs: one program per tile, all its pixels at once, around the functions of `pixel`.

The Triton backend lowers the kernels. Their buffers are those of `native.passes` without the cutoff. A splat's
gradient is summed over the tile's pixels and added atomically, so that gradients are reproducible to rounding only.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import pallas as pl
from jax.typing import DTypeLike

from a2tg_jax.appearance import AppearanceRule, StaticRule
from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Lookup, TextureRegion
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.kernels.choice import triton
from a2tg_jax.rasterize.kernels.packing import num_numbers, pack_regions, pack_splats, unpack_splats
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

IS_COMPILED_AHEAD = False
"""Whether a machine without a GPU compiles the kernels for one that has a GPU; else CPUs interpret them."""


def _is_interpreted() -> bool:
    return jax.default_backend() == "cpu" and not IS_COMPILED_AHEAD


Ref = Any
"""Buffer of a kernel, a reference of Pallas; indexed as an array."""


class _Tile(NamedTuple):
    """Pixels and list of a program's tile."""

    center_x: Array
    """Horizontal coordinate of the centre, in pixels of the image."""
    center_y: Array
    """Vertical coordinate of the centre."""
    x: Array
    """[P] horizontal coordinates of the pixels, from the centre."""
    y: Array
    """[P] vertical coordinates of the pixels, from the centre."""
    is_inside: Array
    """[P] whether the pixels belong to the image."""
    first: Array
    """Start of the tile's list."""
    last: Array
    """End of the tile's list, excluded."""


def _tile(grid: TileGrid, starts: Ref, dtype: DTypeLike) -> _Tile:
    """Return the tile of this program."""
    index, size = pl.program_id(0), grid.tile_size
    center_x = ((index % grid.columns) * size).astype(dtype) + size / 2
    center_y = ((index // grid.columns) * size).astype(dtype) + size / 2
    place = jax.lax.iota(jnp.int32, size**2)
    x = (place % size).astype(dtype) - (size - 1) / 2
    y = (place // size).astype(dtype) - (size - 1) / 2
    is_inside = (center_x + x < grid.width) & (center_y + y < grid.height)
    return _Tile(center_x, center_y, x, y, is_inside, starts[index], starts[index + 1])


def _splat(splats: Ref, id_: Array, settings: CompositingSettings) -> pixel.Splat:
    """Load one of the splats packed by `pack_splats`."""
    has_geometry, normal_at = settings.has_geometry, 10 + settings.num_colors
    first_of_rule = num_numbers(has_geometry, settings.num_colors)
    numbers: Any = [splats[id_, k] for k in range(splats.shape[1])]
    M: Any = tuple(tuple(numbers[3 * i : 3 * i + 3]) for i in range(3))
    normal = tuple(numbers[normal_at:first_of_rule]) if has_geometry else None
    of_rule = tuple(numbers[first_of_rule:])
    return pixel.Splat(M, numbers[9], tuple(numbers[10:normal_at]), normal, of_rule)


def _look_up(
    settings: CompositingSettings, rule: AppearanceRule, regions: Ref, texels: Ref, id_: Array, planes: pixel.Planes,
    tile: _Tile,
) -> Lookup | None:  # fmt: skip
    """Look up a splat's texture at the pixels of a tile, [P] each.

    Returns None if the rule has no textures: `regions` then has one unused column.
    """
    if regions.shape[1] < len(TextureRegion._fields):
        return None
    hit = pixel.intersect(planes, tile.x, tile.y, settings.near_plane, rule.has_low_pass)
    region = TextureRegion(*(regions[id_, k] for k in range(len(TextureRegion._fields))))
    corners = bilinear.corners_of(region, *rule.texel_position(region, hit.u, hit.v))
    at_corners = tuple(tuple(texels[corner.texel, column] for column in range(texels.shape[1])) for corner in corners)
    sample = bilinear.or_empty(bilinear.interpolate(corners, at_corners), region, rule.empty)
    return Lookup(region, sample, corners)


def _is_unfinished(tile: _Tile, carry: tuple[Any, ...]) -> Any:
    """Return whether splats and live pixels are left."""
    at, _, live, _ = carry
    return (at < tile.last) & (jnp.max(live) > 0)


def _forward_kernel(
    settings: CompositingSettings, rule: AppearanceRule, ids: Ref, starts: Ref, splats: Ref, regions: Ref, texels: Ref,
    result: Ref,
) -> None:  # fmt: skip
    tile = _tile(settings.grid, starts, splats.dtype)

    def add_splat(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        at, transmittance, live, channels = carry
        id_ = ids[at]
        splat = _splat(splats, id_, settings)
        planes = pixel.planes_of(splat.M, tile.center_x, tile.center_y)
        lookup = _look_up(settings, rule, regions, texels, id_, planes, tile)
        values = () if lookup is None else lookup.sample.values
        added, transmittance, is_live = pixel.blend(
            rule, settings.near_plane, planes, splat, values, tile.x, tile.y, transmittance, live > 0
        )
        channels = tuple(total + more for total, more in zip(channels, added, strict=True))
        return at + 1, transmittance, is_live.astype(jnp.int32), channels

    dark = jnp.zeros_like(tile.x)
    carry = (tile.first, jnp.ones_like(tile.x), tile.is_inside.astype(jnp.int32), (dark,) * settings.num_channels)
    _, transmittance, _, channels = jax.lax.while_loop(functools.partial(_is_unfinished, tile), add_splat, carry)
    for k, channel in enumerate((*channels, transmittance)):
        result[pl.program_id(0), k, :] = channel


def _backward_kernel(
    settings: CompositingSettings, rule: AppearanceRule, ids: Ref, starts: Ref, splats: Ref, regions: Ref, texels: Ref,
    g: Ref, suffix_sum: Ref, jacobian: Ref, *zeros_and_results: Ref,
) -> None:  # fmt: skip
    d_splats, d_texels, d_probe = zeros_and_results[3:]
    tile = _tile(settings.grid, starts, splats.dtype)
    index = pl.program_id(0)
    cotangents = tuple(g[index, k, :] for k in range(settings.num_channels))
    axes = tuple(tuple(jacobian[i, k] for k in range(3)) for i in range(3))

    def add_splat(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        at, transmittance, live, suffix_sum = carry
        id_ = ids[at]
        splat = _splat(splats, id_, settings)
        planes, to_M = jax.vjp(lambda M: pixel.planes_of(M, tile.center_x, tile.center_y), splat.M)
        lookup = _look_up(settings, rule, regions, texels, id_, planes, tile)
        # A number per pixel, so that each pixel has a cotangent of its own.
        spread = functools.partial(jax.tree.map, lambda number: jnp.broadcast_to(number, tile.x.shape))
        (transmittance, is_live, suffix_sum), weight, d = pixel.blend_vjp(
            rule, settings.near_plane, spread(planes), spread(splat), lookup, tile.x, tile.y, transmittance, live > 0,
            suffix_sum, cotangents, settings.statistic is not None,
        )  # fmt: skip
        contributes = weight != 0

        # Selected, not multiplied: the cotangents of a pixel that shows nothing may not be finite.
        def total(x: Array) -> Array:
            return jnp.sum(jnp.where(contributes, x, jnp.zeros_like(x)))

        d_planes, *others = jax.tree.map(total, (d.planes, d.opacity, d.color, d.normal, d.numbers))
        for k, number in enumerate(jax.tree.leaves((to_M(d_planes), *others))):
            _add(d_splats, (id_, k), number)
        if lookup is not None:
            _add_texels(d_texels, lookup, [jnp.where(contributes, value, jnp.zeros_like(value)) for value in d.values])
        if settings.statistic and d.rho is not None:
            added = pixel.positional_gradient(
                settings.statistic, splat.M, tile.x, tile.y, tile.center_x, tile.center_y, d.rho, axes,
                settings.near_plane, rule.has_low_pass,
            )  # fmt: skip
            for k, number in enumerate((*map(total, added), jnp.sum(contributes.astype(weight.dtype)))):
                _add(d_probe, (id_, k), number)
        return at + 1, transmittance, is_live.astype(jnp.int32), suffix_sum

    carry = (tile.first, jnp.ones_like(tile.x), tile.is_inside.astype(jnp.int32), suffix_sum[index, :])
    jax.lax.while_loop(functools.partial(_is_unfinished, tile), add_splat, carry)


def _triton() -> Any:
    module = triton()
    if module is None:
        raise ValueError("this JAX has no Triton backend of Pallas: use compositor='xla', or 'auto'")
    return module


def _add(total: Ref, place: tuple[Array, int], number: Array) -> None:
    """Add a number to an entry to which other programs also add."""
    row, column = place
    if _is_interpreted():
        total[row, column] += number
    else:
        _triton().atomic_add(total, (row, jnp.int32(column)), number)


def _add_texels(d_texels: Ref, lookup: Lookup, d_values: list[Array]) -> None:
    """Add the cotangents of C values [P] to the texels that they were read from."""

    def add_sums() -> None:
        for column, d_value in enumerate(d_values):
            _add(d_texels, (lookup.region.first, column), jnp.sum(d_value))

    def add_each() -> None:
        for corner in lookup.corners:
            for column, d_value in enumerate(d_values):
                _add_all(d_texels, corner.texel, column, corner.weight * d_value)

    area = lookup.region.height * lookup.region.width
    # With one texel, all pixels would add to it one after the other; with none, they would add to another splat's.
    jax.lax.cond(area == 1, add_sums, lambda: jax.lax.cond(area == 0, lambda: None, add_each))


def _add_all(total: Ref, rows: Array, column: int, numbers: Array) -> None:
    """Add numbers [P] to entries [P] of a column, which may repeat; the interpreter would lose repeated ones."""
    if not _is_interpreted():
        _triton().atomic_add(total, (rows, jnp.full_like(rows, column)), numbers)
        return

    def add_one(k: Array, _: int) -> int:
        is_it = jax.lax.iota(jnp.int32, rows.shape[0]) == k
        row = jnp.sum(jnp.where(is_it, rows, 0))
        total[row, column] += jnp.sum(jnp.where(is_it, numbers, jnp.zeros_like(numbers)))
        return 0

    jax.lax.fori_loop(0, rows.shape[0], add_one, 0)


def _shaped(shape: tuple[int, ...], dtype: DTypeLike) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)  # type: ignore[no-untyped-call]


def _call(
    grid: TileGrid, kernel: Callable[..., None], shapes: Any, num_inputs: int, aliases: dict[int, int]
) -> Callable[..., Any]:
    """Return a function of arrays that runs a kernel for every tile; `shapes` are those of its results."""
    everything = pl.BlockSpec(memory_space=pl.ANY)
    # Two pixels a thread in tiles of 16×16.
    num_warps = min(4, max(1, grid.tile_size**2 // 64))
    params = {} if _is_interpreted() else {"compiler_params": _triton().CompilerParams(num_warps, 1)}
    return pl.pallas_call(
        kernel,
        out_shape=shapes,
        grid=(grid.num,),
        in_specs=[everything] * num_inputs,
        out_specs=jax.tree.map(lambda _: everything, shapes),
        input_output_aliases=aliases,
        interpret=_is_interpreted(),
        **params,
    )


def _inputs(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None, lists: TileLists
) -> tuple[Array, ...]:
    """Return ids, starts, splats, regions and texels, with one unused texel or column if the rule has none."""
    packed = pack_splats(splats, settings.has_geometry)
    texels = texels if texels.shape[1] else jnp.zeros((1, 1), packed.dtype)
    return lists.ids, lists.starts, packed, pack_regions(regions, least_columns=1), texels


def forward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, 1, D, P] and transmittance [tiles, 1, P], as `xla.forward` does."""
    kernel = functools.partial(_forward_kernel, settings, static.rule)
    shape = _shaped((settings.grid.num, settings.num_channels + 1, settings.grid.tile_size**2), splats.M.dtype)
    inputs = _inputs(settings, splats, texels, regions, lists)
    image = _call(settings.grid, kernel, shape, len(inputs), {})(*inputs)[:, None]
    return image[:, :, :-1], image[:, :, -1]


def backward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    kernel = functools.partial(_backward_kernel, settings, static.rule)
    inputs = (
        *_inputs(settings, splats, texels, regions, lists),
        g[:, 0],
        suffix_sum[:, 0],
        jacobian.astype(splats.M.dtype),
    )
    zeros = (jnp.zeros_like(inputs[2]), jnp.zeros_like(inputs[4]), jnp.zeros_like(probe))
    shapes = tuple(_shaped(zero.shape, zero.dtype) for zero in zeros)
    aliases = {len(inputs) + k: k for k in range(3)}
    call = _call(settings.grid, kernel, shapes, len(inputs) + 3, aliases)
    packed, d_texels, d_probe = call(*inputs, *zeros)
    d_splats = unpack_splats(packed, splats, settings.has_geometry)
    return d_splats, d_texels if texels.shape[1] else jnp.zeros_like(texels), d_probe
