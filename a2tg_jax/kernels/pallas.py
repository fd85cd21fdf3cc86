"""Compositing by Pallas kernels on GPUs: one program per tile, all its pixels at once, around the functions of `pixel`.

The kernels are lowered by the Triton backend. Their buffers are those of `loops`, but for the cutoff. What a splat adds
to the gradient is summed over the tile's pixels and added atomically: gradients are reproducible to rounding only.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import pallas as pl

from a2tg_jax import bilinear, pixel
from a2tg_jax.bilinear import Image
from a2tg_jax.kernels.choice import triton
from a2tg_jax.kernels.packing import num_numbers, pack_images, pack_splats, unpack_splats
from a2tg_jax.tiles import TileGrid

IS_COMPILED_AHEAD = False
"""Set where kernels are compiled on a machine that has no GPU, for one that has; else CPUs interpret them."""


def _is_interpreted() -> bool:
    return jax.default_backend() == "cpu" and not IS_COMPILED_AHEAD


class _Tile(NamedTuple):
    """Where a program's pixels are."""

    center_x: Array
    center_y: Array
    x: Array
    """[P] from the centre."""
    y: Array
    is_inside: Array
    first: Array
    last: Array


def _tile(grid: TileGrid, starts, dtype) -> _Tile:
    index, size = pl.program_id(0), grid.tile_size
    center_x = ((index % grid.columns) * size).astype(dtype) + size / 2
    center_y = ((index // grid.columns) * size).astype(dtype) + size / 2
    place = jax.lax.iota(jnp.int32, size**2)
    x = (place % size).astype(dtype) - (size - 1) / 2
    y = (place // size).astype(dtype) - (size - 1) / 2
    is_inside = (center_x + x < grid.width) & (center_y + y < grid.height)
    return _Tile(center_x, center_y, x, y, is_inside, starts[index], starts[index + 1])


def _splat(splats, id_, has_geometry: bool) -> pixel.Splat:
    first_of_rule = num_numbers(has_geometry)
    numbers = [splats[id_, k] for k in range(splats.shape[1])]
    M = tuple(tuple(numbers[3 * i : 3 * i + 3]) for i in range(3))
    normal = tuple(numbers[13:16]) if has_geometry else None
    of_rule = tuple(numbers[first_of_rule:])
    return pixel.Splat(M, numbers[9], tuple(numbers[10:13]), normal, of_rule)  # type: ignore[arg-type]


class _Read(NamedTuple):
    """What the pixels of a tile see of an image; [P] each."""

    image: Image
    """Scalars."""
    taps: tuple[bilinear.Tap, ...]
    sample: bilinear.Sample


def _read(how, rule, images, table, id_, planes, tile: _Tile) -> _Read | None:
    """None where the rule has no images: there is then but one column, of nothing."""
    if images.shape[1] < len(Image._fields):
        return None
    hit = pixel.intersect(planes, tile.x, tile.y, how.near_plane, rule.has_low_pass)
    image = Image(*(images[id_, k] for k in range(len(Image._fields))))
    taps = bilinear.taps(image, *rule.texel(image, hit.u, hit.v))
    texels = tuple(tuple(table[tap.entry, column] for column in range(table.shape[1])) for tap in taps)
    return _Read(image, taps, bilinear.interpolate(taps, texels))


def _is_unfinished(tile: _Tile, carry) -> Array:
    at, _, live, _ = carry
    return (at < tile.last) & (jnp.max(live) > 0)


def _forward_kernel(how, rule, ids, starts, splats, images, table, result):
    tile = _tile(how.grid, starts, splats.dtype)

    def add_splat(carry):
        at, light, live, channels = carry
        id_ = ids[at]
        splat = _splat(splats, id_, how.has_geometry)
        planes = pixel.planes_of(splat.M, tile.center_x, tile.center_y)
        read = _read(how, rule, images, table, id_, planes, tile)
        values = () if read is None else read.sample.values
        at_pixel = planes, splat, values, tile.x, tile.y, light, live > 0
        added, light, is_live = pixel.composite(rule, how.near_plane, *at_pixel)
        channels = tuple(total + more for total, more in zip(channels, added, strict=True))
        return at + 1, light, is_live.astype(jnp.int32), channels

    dark = jnp.zeros_like(tile.x)
    carry = (tile.first, jnp.ones_like(tile.x), tile.is_inside.astype(jnp.int32), (dark,) * how.num_channels)
    _, light, _, channels = jax.lax.while_loop(functools.partial(_is_unfinished, tile), add_splat, carry)
    for k, channel in enumerate((*channels, light)):
        result[pl.program_id(0), k, :] = channel


def _backward_kernel(
    how, rule, ids, starts, splats, images, table, g, behind, jacobian, *zeros_and_results
):  # fmt: skip
    d_splats, d_table, d_tap = zeros_and_results[3:]
    tile = _tile(how.grid, starts, splats.dtype)
    index = pl.program_id(0)
    cotangents = tuple(g[index, k, :] for k in range(how.num_channels))
    axes = tuple(tuple(jacobian[i, k] for k in range(3)) for i in range(3))

    def add_splat(carry):
        at, light, live, behind = carry
        id_ = ids[at]
        splat = _splat(splats, id_, how.has_geometry)
        planes, to_M = jax.vjp(lambda M: pixel.planes_of(M, tile.center_x, tile.center_y), splat.M)
        read = _read(how, rule, images, table, id_, planes, tile)
        image, sample = (None, None) if read is None else (read.image, read.sample)
        # A number per pixel, so that each pixel has a cotangent of its own.
        spread = lambda tree: jax.tree.map(lambda number: jnp.broadcast_to(number, tile.x.shape), tree)  # noqa: E731
        at_pixel = spread(planes), spread(splat), image, sample, tile.x, tile.y, light, live > 0
        (light, is_live, behind), weight, d = pixel.composite_vjp(
            rule, how.near_plane, *at_pixel, behind, cotangents, how.statistic is not None
        )
        contributes = weight != 0
        # Chosen, not multiplied: what a pixel that shows nothing would give may not be finite.
        total = lambda x: jnp.sum(jnp.where(contributes, x, jnp.zeros_like(x)))  # noqa: E731
        d_planes, *others = jax.tree.map(total, (d.planes, d.opacity, d.color, d.normal, d.numbers))
        for k, number in enumerate(jax.tree.leaves((to_M(d_planes), *others))):
            _add(d_splats, (id_, k), number)
        if read is not None:
            _add_texels(d_table, read, [jnp.where(contributes, value, jnp.zeros_like(value)) for value in d.values])
        if how.statistic:
            moved = splat.M, tile.x, tile.y, tile.center_x, tile.center_y, d.rho, axes
            added = pixel.positional_gradient(how.statistic, *moved, how.near_plane, rule.has_low_pass)
            for k, number in enumerate((*map(total, added), jnp.sum(contributes.astype(weight.dtype)))):
                _add(d_tap, (id_, k), number)
        return at + 1, light, is_live.astype(jnp.int32), behind

    carry = (tile.first, jnp.ones_like(tile.x), tile.is_inside.astype(jnp.int32), behind[index, :])
    jax.lax.while_loop(functools.partial(_is_unfinished, tile), add_splat, carry)


def _triton() -> Any:
    module = triton()
    if module is None:
        raise ValueError("this JAX has no Triton backend of Pallas: use compositor='xla', or 'auto'")
    return module


def _add(total, place: tuple[Array, int], number: Array) -> None:
    """Adds a number to an entry that other programs add to as well."""
    row, column = place
    if _is_interpreted():
        total[row, column] += number
    else:
        _triton().atomic_add(total, (row, jnp.int32(column)), number)


def _add_texels(d_table, read: _Read, d_values: list[Array]) -> None:
    """Adds the cotangents of C values [P] to the texels that they were read from."""

    def add_sums() -> None:
        for column, d_value in enumerate(d_values):
            _add(d_table, (read.image.first, column), jnp.sum(d_value))

    def add_each() -> None:
        for tap in read.taps:
            for column, d_value in enumerate(d_values):
                _add_all(d_table, tap.entry, column, tap.weight * d_value)

    # All pixels would add to one and the same texel, one after the other.
    jax.lax.cond(read.image.height * read.image.width == 1, add_sums, add_each)


def _add_all(total, rows: Array, column: int, numbers: Array) -> None:
    """Adds numbers [P] to entries [P] of a column, which may repeat. The interpreter would lose repeated ones."""
    if not _is_interpreted():
        _triton().atomic_add(total, (rows, jnp.full_like(rows, column)), numbers)
        return

    def add_one(k, _):
        is_it = jax.lax.iota(jnp.int32, rows.shape[0]) == k
        row = jnp.sum(jnp.where(is_it, rows, 0))
        total[row, column] += jnp.sum(jnp.where(is_it, numbers, jnp.zeros_like(numbers)))
        return 0

    jax.lax.fori_loop(0, rows.shape[0], add_one, 0)


def _call(grid: TileGrid, kernel, shapes, num_inputs: int, aliases: dict[int, int]):
    everything = pl.BlockSpec(memory_space=pl.ANY)
    # Two pixels a thread, in tiles of 16×16.
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


def _inputs(how, splats, table: Array, images, lists) -> tuple[Array, ...]:
    """ids, starts, splats, images and table; without images or columns there is one that is not read."""
    packed = pack_splats(splats, how.has_geometry)
    table = table if table.shape[1] else jnp.zeros((1, 1), packed.dtype)
    return lists.ids, lists.starts, packed, pack_images(images, least_columns=1), table


def forward(how, rule, splats, table: Array, images, cutoff: Array, lists) -> tuple[Array, Array]:
    """As `compositor._forward`: channels [tiles, 1, D, P] and transmittance [tiles, 1, P]."""
    kernel = functools.partial(_forward_kernel, how, rule.rule)
    shape = jax.ShapeDtypeStruct((how.grid.num, how.num_channels + 1, how.grid.tile_size**2), splats.M.dtype)
    inputs = _inputs(how, splats, table, images, lists)
    image = _call(how.grid, kernel, shape, len(inputs), {})(*inputs)[:, None]
    return image[:, :, :-1], image[:, :, -1]


def backward(
    how, rule, splats, table: Array, images, cutoff: Array, lists, jacobian, tap: Array, g: Array, behind: Array
):
    """As `compositor._backward`."""
    kernel = functools.partial(_backward_kernel, how, rule.rule)
    inputs = (*_inputs(how, splats, table, images, lists), g[:, 0], behind[:, 0], jacobian.astype(splats.M.dtype))
    zeros = (jnp.zeros_like(inputs[2]), jnp.zeros_like(inputs[4]), jnp.zeros_like(tap))
    shapes = tuple(jax.ShapeDtypeStruct(zero.shape, zero.dtype) for zero in zeros)
    aliases = {len(inputs) + k: k for k in range(3)}
    call = _call(how.grid, kernel, shapes, len(inputs) + 3, aliases)
    packed, d_table, d_tap = call(*inputs, *zeros)
    d_splats = unpack_splats(packed, splats, how.has_geometry)
    return d_splats, d_table if table.shape[1] else jnp.zeros_like(table), d_tap
