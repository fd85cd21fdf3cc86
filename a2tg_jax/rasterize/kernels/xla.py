"""Compositing by XLA on every device, with array operations only; tests compare `native` and `cuda` with it.

G tiles at a time, P pixels a tile, B splats a block, D channels (colour, then depth, depth² and normal with geometry).
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import elementwise_functions
from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Lookup, TextureRegion
from a2tg_jax.core.numerics import pixel_sum, spread_to_pixels
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.splats import CompositingSettings, PassInputs, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels

BLOCK = 8
"""Number B of splats that are composited at once."""

Totals = tuple[Array, Array, Array]
"""Cotangents of all splats, packed as [N, S], of the texels [T, C], and of the probe [N, 4]."""
Block = tuple[Splats, TextureRegion | None]
"""Splats of a block [..., B], and their texture regions."""
TexelAddends = tuple[Array, Array]
"""Indices of texels [corners, B, P], and addends to their cotangents [corners, B, P, C]."""
BlockCotangents = tuple[Splats, Array | None, TexelAddends | None]
"""Cotangents of a block's splats, of the probe [B, 4], and of the texels."""


class Tiles(NamedTuple):
    """One tile, or G of them."""

    x: Array
    """Horizontal coordinate of its centre, in pixels of the image."""
    y: Array
    """Vertical coordinate of its centre."""
    end: Array
    """End of its list."""
    pixels: TilePixels | None = None
    """Its pixels, if the camera has a ray for each pixel; the centre is then that of the rays."""


def forward(settings: CompositingSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P].

    Args:
      settings: static options, with the number G of tiles of a group.
      inputs: arrays of the pass.
    """
    on_blocks = _TracedPass(settings, inputs)
    return on_blocks.front_to_back(on_blocks.block, jax.lax.while_loop)


def composite_in_any_mode(settings: CompositingSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `forward`; JAX differentiates the code itself.

    It does so in any mode and to any order. This is slower than `forward` and `backward`, and a gradient keeps the
    state of the pixels of one tile before each block of its splats.
    """
    # No list is longer than this; blocks behind the end of all lists of a group are skipped.
    num_blocks = -(-min(inputs.lists.ids.shape[0], inputs.splats.M.shape[0]) // BLOCK)

    def repeat(is_unfinished: Any, step: Any, carry: object) -> Any:
        def step_or_skip(carry: object, _: None) -> tuple[Any, None]:
            return jax.lax.cond(is_unfinished(carry), step, lambda carry: carry, carry), None

        # JAX differentiates loops of a fixed length only.
        return jax.lax.scan(jax.checkpoint(step_or_skip), carry, length=num_blocks)[0]

    on_blocks = _TracedPass(settings, inputs)
    return on_blocks.front_to_back(on_blocks.block_in_any_mode, repeat, each_group=jax.checkpoint)


def backward(
    settings: CompositingSettings, inputs: PassInputs, jacobian: Array, probe: Array, g: Array, suffix_sum: Array
) -> tuple[Splats, Array, Array]:
    """Return the cotangents of splats, texels and probe.

    Args:
      settings, inputs: as for `forward`.
      jacobian, probe: as for `rasterize.compositor.composite`.
      g: [tiles, D, P] cotangents of the channels.
      suffix_sum: [tiles, P] B of the whole list (`rasterize.pixel.absorb_vjp`).
    """
    on_blocks, splats = _TracedPass(settings, inputs), inputs.splats
    widths = [math.prod(leaf.shape[1:]) for leaf in splats]
    # One row per splat: one scatter adds a block, where each field would need its own.
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)
    totals = packed, jnp.zeros_like(inputs.texels), jnp.zeros_like(probe)

    def grouped(x: Array) -> Array:
        """Return an array [tiles, ...] as [groups, G, ...], filled up with zeros."""
        missing = settings.num_groups * settings.tile_batch - x.shape[0]
        x = jnp.pad(x, [(0, missing), *[(0, 0)] * (x.ndim - 1)])
        return x.reshape(settings.num_groups, settings.tile_batch, *x.shape[1:])

    g, suffix_sum = grouped(g), grouped(suffix_sum)

    def group(index: Array, totals: Totals) -> Totals:
        tiles, start = on_blocks.tiles_of_group(index)
        pull_back = on_blocks.over_tiles(functools.partial(on_blocks.block_vjp, jacobian))

        def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            at, *state, totals = carry
            in_block = on_blocks.block_ids(at)
            *state, d_rows = pull_back(on_blocks.gather(in_block), at, tiles, *state, g[index])
            return (at + BLOCK, *state, _accumulate(totals, in_block, d_rows))

        carry = (start, *on_blocks.initial_pixels(tiles), suffix_sum[index], totals)
        totals = jax.lax.while_loop(functools.partial(_has_splats_left, tiles.end), step, carry)[-1]
        return totals

    packed, d_texels, d_probe = jax.lax.fori_loop(jnp.int32(0), jnp.int32(settings.num_groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_texels, d_probe


class _TracedPass:
    """A pass over groups of tiles, block by block."""

    def __init__(self, settings: CompositingSettings, inputs: PassInputs):
        self.settings, self.spec, self.grid = settings, settings.kernel, settings.grid
        self.functions = elementwise_functions(self.spec.static, self.spec.arguments)
        self.splats, self.texels, self.regions, _, self.lists = inputs
        self.dtype = self.splats.M.dtype
        # With one block of padding, so that every block can be read whole.
        self.ids = jnp.concatenate([self.lists.ids, jnp.zeros(BLOCK, self.lists.ids.dtype)])

    def front_to_back(
        self, block: Callable[..., object], repeat: Callable[..., Any],
        each_group: Callable[..., object] = lambda group: group,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Composite all tiles.

        Args:
          block: function that composites one block over one tile.
          repeat: `jax.lax.while_loop`, or a loop like it.
          each_group: transformation of the function of one group.
        """
        settings = self.settings

        def group(index: Array) -> tuple[Array, Array]:
            tiles, start = self.tiles_of_group(index)
            add_block = self.over_tiles(block)

            def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
                at, transmittance, is_live, channels = carry
                rows = self.gather(self.block_ids(at))
                added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
                return at + BLOCK, transmittance, is_live, channels + added

            shape = settings.tile_batch, self.spec.num_channels, self.grid.tile_size**2
            carry = (start, *self.initial_pixels(tiles), jnp.zeros(shape, self.dtype))
            _, transmittance, _, channels = repeat(functools.partial(_has_splats_left, tiles.end), step, carry)
            return channels, transmittance

        images: tuple[Array, Array] = jax.lax.map(each_group(group), jnp.arange(settings.num_groups, dtype=jnp.int32))
        # Without the tiles that fill up the last group.
        channels, transmittance = (x.reshape(-1, *x.shape[2:])[: self.grid.num] for x in images)
        return channels, transmittance

    def tiles_of_group(self, index: Array) -> tuple[Tiles, Array]:
        """Return the tiles of a group, and the starts of their lists [G]; tiles past the last one have empty lists."""
        grid, lists = self.grid, self.lists
        tile = index * self.settings.tile_batch + jnp.arange(self.settings.tile_batch, dtype=jnp.int32)
        size = grid.tile_size
        x = (tile % grid.columns).astype(self.dtype) * size + size / 2
        y = (tile // grid.columns).astype(self.dtype) * size + size / 2
        is_real = tile < grid.num
        # The last group is filled up with copies of the last tile, whose lists are empty.
        tile = jnp.minimum(tile, grid.num - 1)
        start = lists.starts[tile]
        end = jnp.where(is_real, lists.starts[tile + 1], start)
        if lists.pixels is None:
            return Tiles(x, y, end), start
        own: TilePixels = jax.tree.map(lambda leaf: leaf[tile], lists.pixels)
        own = own._replace(is_seen=own.is_seen & is_real[:, None])
        return Tiles(own.centers[:, 0], own.centers[:, 1], end, own), start

    def initial_pixels(self, tiles: Tiles) -> tuple[Array, Array]:
        """Return transmittance 1 [G, P], and the live pixels [G, P]; those that are not shown never are."""
        if tiles.pixels is not None:
            return jnp.ones_like(tiles.pixels.is_seen, self.dtype), tiles.pixels.is_seen
        x, y = self.pixel_offsets(tiles)
        height = self.lists.height_in(self.grid)
        is_inside = (tiles.x[:, None] + x < self.grid.width) & (tiles.y[:, None] + y < height)
        return jnp.ones_like(is_inside, self.dtype), is_inside

    def over_tiles(self, function: Callable[..., object]) -> Callable[..., Any]:
        """Map a function of one tile over a leading axis of G tiles; a single one needs no vmap."""
        if self.settings.tile_batch > 1:
            return jax.vmap(function)
        take, put = (lambda x: x[0]), (lambda x: x[None])
        return lambda *args: jax.tree.map(put, function(*jax.tree.map(take, args)))

    def block_ids(self, at: Array) -> Array:
        """Return the splats [G, B] of the blocks that start at `at` [G]."""
        if at.shape[0] == 1:
            return jax.lax.dynamic_slice(self.ids, (at[0],), (BLOCK,))[None]
        # Tiles whose lists have ended go on with their group: their blocks may begin behind all lists.
        places = at[:, None] + jnp.arange(BLOCK, dtype=jnp.int32)[None, :]
        return self.ids[jnp.minimum(places, self.ids.shape[0] - 1)]

    def gather(self, ids: Array) -> Block:
        """Return the splats [G, B, ...] of some ids [G, B], and their texture regions."""
        flat = ids.reshape(-1)
        rows = jax.tree.map(lambda x: x[flat], (self.splats, self.regions))
        return jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)

    def pixel_offsets(self, tile: Tiles) -> tuple[Array, Array]:
        """Return x and y of a tile's pixels, each [1, P]: from its centre, or in its frame."""
        if tile.pixels is not None:
            x, y = tile.pixels.offsets
            return x[None], y[None]
        size = self.grid.tile_size
        y, x = np.mgrid[:size, :size] - (size - 1) / 2
        return jnp.asarray(x.reshape(1, -1), self.dtype), jnp.asarray(y.reshape(1, -1), self.dtype)

    def hits(self, splats: Splats, tile: Tiles) -> pixel.Hit:
        """Return the hits of a tile's pixels with the splats of a block, [B, P] each."""
        x, y = self.pixel_offsets(tile)
        planes = pixel.planes_of(_split(splats, False).M, _numbers_of(tile))
        planes = jax.tree.map(lambda entry: spread_to_pixels(entry, x.shape[1]), planes)
        return pixel.intersect(planes, x, y, self.spec.near_plane, self.functions.has_low_pass)

    def look_up(self, regions: TextureRegion | None, hit: pixel.Hit) -> Lookup | None:
        """Look up the textures of B splats at P pixels, [B, P] each; None without textures."""
        if regions is None:
            return None
        region = jax.tree.map(lambda x: x[:, None], regions)
        corners = bilinear.corners_of(region, *self.functions.texel_position(region, hit.u, hit.v))
        read = self.texels[jnp.stack([corner.texel for corner in corners])]
        sample = bilinear.interpolate(corners, tuple(tuple(jnp.moveaxis(texel, -1, 0)) for texel in read))
        return Lookup(region, bilinear.or_empty(sample, region, self.functions.empty), corners)

    def show(
        self, splats: Splats, hit: pixel.Hit, values: tuple[Array, ...], at: Array, tile: Tiles,
        rho_probe: Array | None = None,
    ) -> pixel.Shown:  # fmt: skip
        """Return what a block shows at a tile's pixels, [B, P] each; entries past the end of the list show nothing."""
        splat = _split(splats, self.spec.has_geometry, self.grid.tile_size**2)
        shown = pixel.show(self.functions, splat, hit, values, rho_probe)
        in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]
        return pixel.Shown(jnp.where(in_list, shown.alpha, 0.0), shown.channels)

    def block(
        self, rows: Block, at: Array, tile: Tiles, transmittance: Array, is_live: Array
    ) -> tuple[Array, Array, Array]:
        """Composite one block of B splats over one tile.

        Args:
          rows: splats of the block, and their texture regions.
          at: position of the block in the list; entries past the tile's end are left out.
          tile: the tile.
          transmittance: [P] before the block.
          is_live: [P] pixels that have not stopped.

        Returns:
          Added channels [D, P], and transmittance and live pixels after the block.
        """
        splats, regions = rows
        hit = self.hits(splats, tile)
        shown = self.show(splats, hit, _values_of(self.look_up(regions, hit)), at, tile)
        return _absorbed(shown.alpha, shown.channels, transmittance, is_live)

    def block_vjp(
        self, jacobian: Array, rows: Block, at: Array, tile: Tiles, transmittance: Array, is_live: Array,
        suffix_sum: Array, g: Array,
    ) -> tuple[Array, Array, Array, BlockCotangents]:  # fmt: skip
        """Differentiate `block`: return the state after the block, and the cotangents of its rows.

        `suffix_sum` [P] is g·(channels added by this block and all behind it) + g_T·T_final; g is [D, P].
        """
        splats, regions = rows
        # Texels are read once, outside of what is differentiated; `_accumulate` adds to their gradient.
        lookup = self.look_up(regions, self.hits(splats, tile))

        def of_floats(splats: Splats, values: tuple[Array, ...], rho_probe: Array | None) -> pixel.Shown:
            hit = self.hits(splats, tile)
            return self.show(splats, hit, pixel.values_at(self.functions, lookup, hit, values), at, tile, rho_probe)

        statistic = self.spec.statistic
        rho_probe = jnp.zeros((BLOCK, transmittance.shape[0]), transmittance.dtype) if statistic else None
        shown, pull_back = jax.vjp(of_floats, splats, _values_of(lookup), rho_probe)
        g = g[:, None]
        seen: Any = sum(channel * g[k] for k, channel in enumerate(shown.channels))

        def add_splat(carry: pixel.State, splat: tuple[Array, Array]) -> tuple[pixel.State, tuple[Array, Array]]:
            weight, *after, d_alpha = pixel.absorb_vjp(splat[0], carry[0], carry[1], carry[2], splat[1])
            return (after[0], after[1], after[2]), (weight, d_alpha)

        carry, (weights, d_alpha) = jax.lax.scan(add_splat, (transmittance, is_live, suffix_sum), (shown.alpha, seen))
        d_shown = pixel.Shown(d_alpha, tuple(weights * g[k] for k in range(self.spec.num_channels)))
        d_splats, d_values, d_rho = pull_back(d_shown)
        d_probe = None
        if statistic:
            x, y = self.pixel_offsets(tile)
            M = jax.tree.map(lambda entry: entry[:, None], _split(splats, False).M)
            near_plane, has_low_pass = self.spec.near_plane, self.functions.has_low_pass
            components = pixel.positional_gradient(
                statistic, M, x, y, _numbers_of(tile), d_rho, jacobian, near_plane, has_low_pass
            )
            num_pixels = pixel_sum((weights > 0).astype(d_rho.dtype))
            d_probe = jnp.stack([*map(pixel_sum, components), num_pixels], axis=1)
        d_texels = None
        if lookup is not None:
            addends = [jnp.stack([corner.weight * d for d in d_values], axis=-1) for corner in lookup.corners]
            d_texels = jnp.stack([corner.texel for corner in lookup.corners]), jnp.stack(addends)
        return *carry, (d_splats, d_probe, d_texels)

    def block_in_any_mode(
        self, rows: Block, at: Array, tile: Tiles, transmittance: Array, is_live: Array
    ) -> tuple[Array, Array, Array]:
        """Composite one block of B splats over one tile; arguments and results are those of `block`."""
        splats, regions = rows
        x, y = self.pixel_offsets(tile)

        def spread(tree: object) -> Any:
            return jax.tree.map(lambda entry: jnp.broadcast_to(entry[:, None], (BLOCK, x.shape[1])), tree)

        splat = _split(splats, self.spec.has_geometry)
        planes, splat = spread(pixel.planes_of(splat.M, _numbers_of(tile))), spread(splat)
        in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]

        def show(planes: pixel.Planes) -> pixel.Shown:
            hit = pixel.intersect(planes, x, y, self.spec.near_plane, self.functions.has_low_pass)
            return pixel.show(self.functions, splat, hit, _values_of(self.look_up(regions, hit)))

        is_shown = in_list & ~(jax.lax.stop_gradient(show(planes).alpha) == 0)
        # Far away from what is shown, derivatives may overflow. A plane that faces the camera keeps them out of the
        # sums.
        shown = show(jax.tree.map(lambda entry, facing: jnp.where(is_shown, entry, facing), planes, _FACING))
        return _absorbed(jnp.where(is_shown, shown.alpha, 0.0), shown.channels, transmittance, is_live)


_FACING: Any = pixel.Planes((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 0.0, 0.0, 1.0)  # type: ignore[arg-type]
"""Planes of a splat at depth 1 that each ray hits at its centre."""


def _has_splats_left(ends: Array, carry: tuple[Any, ...]) -> Array:
    """Return whether a tile of a group has splats left, and live pixels."""
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def _accumulate(totals: Totals, ids: Array, d_rows: BlockCotangents) -> Totals:
    """Add the cotangents of one block per tile to the totals; those of the splats are packed in one row each."""
    flat = ids.reshape(-1)
    splats, texels, probe = totals
    d_splats, d_probe, d_texels = d_rows
    packed = jnp.concatenate([leaf.reshape(flat.shape[0], -1) for leaf in d_splats], axis=1)
    splats = splats.at[flat].add(packed)
    if d_texels is not None:
        indices, addends = d_texels
        texels = texels.at[indices.reshape(-1)].add(addends.reshape(-1, texels.shape[1]))
    return splats, texels, probe if d_probe is None else probe.at[flat].add(d_probe.reshape(flat.shape[0], -1))


def _numbers_of(tile: Tiles) -> pixel.TileNumbers:
    """Return the centre of a tile, and its frame if pixels have rays of their own."""
    if tile.pixels is None:
        return tile.x, tile.y
    # Within vmap: the frame of one tile.
    (xx, xy), (yx, yy) = tile.pixels.frames
    return tile.x, tile.y, xx, xy, yx, yy


def _split(splats: Splats, has_geometry: bool, num: int | None = None) -> pixel.Splat:
    """Split splats [B, ...] into numbers for `pixel`, each [B], or spread over [B, num] pixels."""

    def put(x: Array) -> Array:
        return x if num is None else spread_to_pixels(x, num=num)

    def several(x: Array) -> Any:
        return tuple(put(x[:, k]) for k in range(x.shape[1]))

    M: Any = tuple(tuple(splats.M[:, i, k] for k in range(3)) for i in range(3))
    normal = several(splats.normals) if has_geometry else None
    numbers = several(splats.numbers)
    return pixel.Splat(M, put(splats.opacities), several(splats.colors), normal, numbers)


def _values_of(lookup: Lookup | None) -> tuple[Array, ...]:
    return () if lookup is None else lookup.sample.values


def _absorbed(
    alphas: Array, channels: tuple[Array, ...], transmittance: Array, is_live: Array
) -> tuple[Array, Array, Array]:
    """Composite alphas [B, P] and channels [B, P] of a block; the rest is as for `_TracedPass.block`."""

    def add_splat(carry: tuple[Array, Array], alpha: Array) -> tuple[tuple[Array, Array], Array]:
        weight, transmittance, is_live = pixel.absorb(alpha, *carry)
        return (transmittance, is_live), weight

    (transmittance, is_live), weights = jax.lax.scan(add_splat, (transmittance, is_live), alphas)
    return jnp.stack([_sum_rows(channel * weights) for channel in channels]), transmittance, is_live


def _sum_rows(x: Array) -> Array:
    """Sum the first axis, a power of two long, by halves: a reduction would not be vectorised over pixels."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = x[:half] + x[half:]
    return x[0]
