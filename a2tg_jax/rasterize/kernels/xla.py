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
from a2tg_jax.rasterize.splats import PassInputs, PassSettings, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels

BLOCK = 8
"""Number B of splats that are composited at once; a power of two (`_composited`)."""
_FACING: Any = pixel.Planes((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 0.0, 0.0, 1.0)  # type: ignore[arg-type]
"""Planes of a splat at depth 1 that each ray hits at its centre."""


class Tiles(NamedTuple):
    """One tile, or G of them."""

    x: Array  # horizontal coordinate of its centre, in pixels of the image
    y: Array  # vertical coordinate of its centre
    end: Array  # end of its list
    pixels: TilePixels | None = None
    """Its pixels, if the camera has a ray for each pixel; the centre is then the rays'."""


def forward(settings: PassSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P]; G is `settings.tile_batch`."""
    return _TracedPass(settings, inputs).front_to_back(jax.lax.while_loop)


def composite_in_any_mode(settings: PassSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return the results of `forward`; JAX differentiates the code itself, in any mode and to any order.

    This is slower than `forward` and `backward`, and a gradient keeps the state of the pixels of one tile before each
    block of its splats.
    """
    # No list is longer than this; blocks behind the end of all lists of a group are skipped.
    num_blocks = -(-min(inputs.lists.ids.shape[0], inputs.splats.M.shape[0]) // BLOCK)

    def repeat(is_unfinished: Any, step: Any, carry: object) -> Any:
        def step_or_skip(carry: object, _: None) -> tuple[Any, None]:
            return jax.lax.cond(is_unfinished(carry), step, lambda carry: carry, carry), None

        # JAX differentiates loops of a fixed length only.
        return jax.lax.scan(jax.checkpoint(step_or_skip), carry, length=num_blocks)[0]

    return _TracedPass(settings, inputs, in_any_mode=True).front_to_back(repeat)


def backward(
    settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array, g: Array, suffix_sum: Array
) -> tuple[Splats, Array, Array]:
    """Return the cotangents of splats, texels and probe.

    Args:
      settings, inputs: as for `forward`.
      jacobian, probe: as for `rasterize.compositor.composite`.
      g: [tiles, D, P] cotangents of the channels.
      suffix_sum: [tiles, P] B of the whole list (`rasterize.pixel.absorb_vjp`).
    """
    traced = _TracedPass(settings, inputs)
    splats = inputs.splats
    size = traced.size
    groups = traced.num_groups
    widths = [math.prod(leaf.shape[1:]) for leaf in splats]
    # One row per splat: one scatter adds a block, where each field would need its own.
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)

    def grouped(x: Array) -> Array:
        """Return an array [tiles, ...] as [groups, G, ...], filled up with zeros."""
        x = jnp.pad(x, [(0, groups * size - x.shape[0]), *[(0, 0)] * (x.ndim - 1)])
        return x.reshape(groups, size, *x.shape[1:])

    g = grouped(g)
    suffix_sum = grouped(suffix_sum)

    def group(index: Array, totals: tuple[Array, Array, Array]) -> Any:
        tiles, start = traced.tiles_of_group(index)
        pull_back = traced.over_tiles(functools.partial(traced.block_vjp, jacobian))

        def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            at, *state, (packed, texels, probe) = carry
            ids = traced.block_ids(at)
            *state, (d_splats, d_probe, d_texels) = pull_back(traced.gather(ids), at, tiles, *state, g[index])
            flat = ids.reshape(-1)
            rows = jnp.concatenate([leaf.reshape(flat.shape[0], -1) for leaf in d_splats], axis=1)
            packed = packed.at[flat].add(rows)
            if d_texels is not None:
                indices, addends = d_texels
                texels = texels.at[indices.reshape(-1)].add(addends.reshape(-1, texels.shape[1]))
            if d_probe is not None:
                probe = probe.at[flat].add(d_probe.reshape(flat.shape[0], -1))
            return (at + BLOCK, *state, (packed, texels, probe))

        carry = (start, *traced.initial_pixels(tiles), suffix_sum[index], totals)
        return jax.lax.while_loop(functools.partial(_has_splats_left, tiles.end), step, carry)[-1]

    totals = packed, jnp.zeros_like(inputs.texels), jnp.zeros_like(probe)
    packed, d_texels, d_probe = jax.lax.fori_loop(jnp.int32(0), jnp.int32(groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_texels, d_probe


class _TracedPass:
    """A pass over groups of tiles, block by block."""

    def __init__(self, settings: PassSettings, inputs: PassInputs, in_any_mode: bool = False):
        self.settings = settings
        self.grid = settings.grid
        self.in_any_mode = in_any_mode
        self.size = settings.tile_batch or self.grid.num
        self.num_groups = -(-self.grid.num // self.size)
        self.functions = elementwise_functions(settings.static, settings.arguments)
        self.splats, self.texels, self.regions, _, self.lists = inputs
        self.dtype = self.splats.M.dtype
        # With one block of padding, so that every block can be read whole.
        self.ids = jnp.concatenate([self.lists.ids, jnp.zeros(BLOCK, self.lists.ids.dtype)])

    def front_to_back(self, repeat: Callable[..., Any]) -> tuple[Array, Array]:
        """Composite all tiles; `repeat` is `jax.lax.while_loop`, or a loop like it."""

        def group(index: Array) -> tuple[Array, Array]:
            tiles, start = self.tiles_of_group(index)
            add_block = self.over_tiles(self.block)

            def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
                at, transmittance, is_live, channels = carry
                rows = self.gather(self.block_ids(at))
                added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
                return at + BLOCK, transmittance, is_live, channels + added

            shape = self.size, self.settings.num_channels, self.settings.num_pixels
            carry = (start, *self.initial_pixels(tiles), jnp.zeros(shape, self.dtype))
            _, transmittance, _, channels = repeat(functools.partial(_has_splats_left, tiles.end), step, carry)
            return channels, transmittance

        indices = jnp.arange(self.num_groups, dtype=jnp.int32)
        images: Any = jax.lax.map(jax.checkpoint(group) if self.in_any_mode else group, indices)
        # Without the tiles that fill up the last group.
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: self.grid.num], images)

    def tiles_of_group(self, index: Array) -> tuple[Tiles, Array]:
        """Return the tiles of a group, and the starts of their lists [G]; tiles past the last one have empty lists."""
        grid = self.grid
        lists = self.lists
        size = self.grid.tile_size
        tile = index * self.size + jnp.arange(self.size, dtype=jnp.int32)
        x = (tile % grid.columns).astype(self.dtype) * size + size / 2
        y = (tile // grid.columns).astype(self.dtype) * size + size / 2
        is_real = tile < grid.num
        # The last group is filled up with copies of the last tile, whose lists are empty.
        tile = jnp.minimum(tile, grid.num - 1)
        start = lists.starts[tile]
        end = jnp.where(is_real, lists.starts[tile + 1], start)
        if lists.pixels is None:
            return Tiles(x, y, end), start
        pixels: TilePixels = jax.tree.map(lambda leaf: leaf[tile], lists.pixels)
        pixels = pixels._replace(is_seen=pixels.is_seen & is_real[:, None])
        return Tiles(pixels.centers[:, 0], pixels.centers[:, 1], end, pixels), start

    def initial_pixels(self, tiles: Tiles) -> tuple[Array, Array]:
        """Return transmittance 1 [G, P], and the live pixels [G, P]: those that are shown."""
        if tiles.pixels is not None:
            return jnp.ones_like(tiles.pixels.is_seen, self.dtype), tiles.pixels.is_seen
        x, y = self.pixel_offsets(tiles)
        is_inside = (tiles.x[:, None] + x < self.grid.width) & (tiles.y[:, None] + y < self.grid.height)
        return jnp.ones_like(is_inside, self.dtype), is_inside

    def over_tiles(self, function: Callable[..., object]) -> Callable[..., Any]:
        """Map a function of one tile over a leading axis of G tiles; a single one needs no vmap."""
        if self.size > 1:
            return jax.vmap(function)

        def of_one(*args: Any) -> Any:
            result = function(*jax.tree.map(lambda x: x[0], args))
            return jax.tree.map(lambda x: x[None], result)

        return of_one

    def block_ids(self, at: Array) -> Array:
        """Return the splats [G, B] of the blocks that start at `at` [G]."""
        if at.shape[0] == 1:
            return jax.lax.dynamic_slice(self.ids, (at[0],), (BLOCK,))[None]
        # Tiles whose lists have ended stay in their group: their blocks may begin behind all lists.
        places = at[:, None] + jnp.arange(BLOCK, dtype=jnp.int32)[None, :]
        return self.ids[jnp.minimum(places, self.ids.shape[0] - 1)]

    def gather(self, ids: Array) -> tuple[Splats, TextureRegion | None]:
        """Return the splats [G, B, ...] of some ids [G, B], and their texture regions."""
        flat = ids.reshape(-1)
        rows = jax.tree.map(lambda x: x[flat], (self.splats, self.regions))
        blocks: tuple[Splats, TextureRegion | None] = jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)
        return blocks

    def pixel_offsets(self, tile: Tiles) -> tuple[Array, Array]:
        """Return x and y of a tile's pixels, each [1, P]: from its centre, or in its frame."""
        if tile.pixels is not None:
            x, y = tile.pixels.offsets
            return x[None], y[None]
        size = self.grid.tile_size
        y, x = np.mgrid[:size, :size] - (size - 1) / 2
        return jnp.asarray(x.reshape(1, -1), self.dtype), jnp.asarray(y.reshape(1, -1), self.dtype)

    def spread(self, splats: Splats, tile: Tiles) -> tuple[pixel.Splat, pixel.Planes]:
        """Return the splats of a block and their planes as numbers for `pixel`, [B, P] each."""
        splat = _split(splats, self.settings.has_geometry)
        num = self.settings.num_pixels

        def put(x: Array) -> Array:
            # `spread_to_pixels` has the faster gradient, in reverse mode only.
            return jnp.broadcast_to(x[:, None], (BLOCK, num)) if self.in_any_mode else spread_to_pixels(x, num)

        planes = pixel.planes_of(splat.M, _numbers_of(tile))
        return jax.tree.map(put, splat), jax.tree.map(put, planes)

    def hit(self, planes: pixel.Planes, tile: Tiles) -> pixel.Hit:
        """Return the hits of a tile's pixels with the splats of a block, [B, P] each."""
        x, y = self.pixel_offsets(tile)
        return pixel.intersect(planes, x, y, self.settings.near_plane, self.functions.has_low_pass)

    def look_up(self, regions: TextureRegion | None, hit: pixel.Hit) -> Lookup | None:
        """Look up the textures of B splats at P pixels, [B, P] each; None without textures."""
        if regions is None:
            return None
        region = jax.tree.map(lambda x: x[:, None], regions)
        corners = bilinear.corners_of(region, *self.functions.texel_position(region, hit.u, hit.v))
        read = self.texels[jnp.stack([corner.texel for corner in corners])]
        sample = bilinear.interpolate(corners, tuple(tuple(jnp.moveaxis(texel, -1, 0)) for texel in read))
        return Lookup(region, bilinear.or_empty(sample, region, self.functions.empty), corners)

    def block(
        self, rows: tuple[Splats, TextureRegion | None], at: Array, tile: Tiles, transmittance: Array, is_live: Array
    ) -> tuple[Array, Array, Array]:
        """Composite one block of B splats, with their texture regions, over one tile.

        The block begins at position `at` of the list; entries past the tile's end are left out. Transmittance and live
        pixels are [P] before the block. Returns added channels [D, P], and transmittance and live pixels after it.
        """
        splats, regions = rows
        splat, planes = self.spread(splats, tile)

        def show(planes: pixel.Planes) -> pixel.Shown:
            hit = self.hit(planes, tile)
            return pixel.show(self.functions, splat, hit, _values_of(self.look_up(regions, hit)))

        is_shown = self.is_listed(at, tile)
        if self.in_any_mode:
            # Derivatives may overflow where a splat does not show; with the planes of `_FACING` there, they do not.
            is_shown &= ~(jax.lax.stop_gradient(show(planes).alpha) == 0)
            planes = jax.tree.map(lambda entry, facing: jnp.where(is_shown, entry, facing), planes, _FACING)
        shown = show(planes)
        return _composited(jnp.where(is_shown, shown.alpha, 0.0), shown.channels, transmittance, is_live)

    def is_listed(self, at: Array, tile: Tiles) -> Array:
        """Return which entries of a block are in the tile's list, [B, 1]."""
        return (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]

    def block_vjp(
        self, jacobian: Array, rows: tuple[Splats, TextureRegion | None], at: Array, tile: Tiles,
        transmittance: Array, is_live: Array, suffix_sum: Array, g: Array,
    ) -> Any:  # fmt: skip
        """Differentiate `block`.

        `suffix_sum` [P] is g·(channels added by this block and all behind it) + g_T·T_final; g is [D, P].

        Returns:
          Transmittance, live pixels and suffix sum after the block; and the cotangents of its splats, of the probe
          [B, 4] or None, and of texels: indices [corners, B, P] and addends [corners, B, P, C], or None.
        """
        splats, regions = rows
        # Texels are read once, outside of what is differentiated; `backward` adds to their gradient.
        _, planes = self.spread(splats, tile)
        hit = self.hit(planes, tile)
        lookup = self.look_up(regions, hit)

        def of_floats(splats: Splats, values: tuple[Array, ...], rho_probe: Array | None) -> pixel.Shown:
            if self.settings.only_colors:
                fixed, values = jax.lax.stop_gradient((splats, values))
                splats = fixed._replace(colors=splats.colors)
            splat, planes = self.spread(splats, tile)
            hit = self.hit(planes, tile)
            values = pixel.values_at(self.functions, lookup, hit, values)
            shown = pixel.show(self.functions, splat, hit, values, rho_probe)
            return shown._replace(alpha=jnp.where(self.is_listed(at, tile), shown.alpha, 0.0))

        statistic = self.settings.statistic
        rho_probe = jnp.zeros((BLOCK, transmittance.shape[0]), transmittance.dtype) if statistic else None
        shown, pull_back = jax.vjp(of_floats, splats, _values_of(lookup), rho_probe)
        g = g[:, None]
        g_dot_c: Any = sum(channel * g[k] for k, channel in enumerate(shown.channels))

        def add_splat(state: pixel.State, splat: tuple[Array, Array]) -> tuple[pixel.State, tuple[Array, Array]]:
            alpha, g_dot_c = splat
            weight, transmittance, is_live, suffix_sum, d_alpha = pixel.absorb_vjp(alpha, *state, g_dot_c)
            return (transmittance, is_live, suffix_sum), (weight, d_alpha)

        state = (transmittance, is_live, suffix_sum)
        state, (weights, d_alpha) = jax.lax.scan(add_splat, state, (shown.alpha, g_dot_c))
        d_shown = pixel.Shown(d_alpha, tuple(weights * g[k] for k in range(self.settings.num_channels)))
        d_splats, d_values, d_rho = pull_back(d_shown)
        d_probe = d_texels = None
        if statistic:
            M = jax.tree.map(lambda entry: entry[:, None], _split(splats, False).M)
            # Of a splat that does not show, the slope of the falloff may be NaN.
            d_rho = jnp.where(weights > 0, d_rho, 0.0)
            of_pixels = hit, *self.pixel_offsets(tile), _numbers_of(tile), d_rho, jacobian
            components = pixel.positional_gradient(statistic, M, *of_pixels)
            num_pixels = (weights > 0).astype(d_rho.dtype)
            d_probe = jnp.stack([pixel_sum(numbers) for numbers in (*components, num_pixels)], axis=1)
        if lookup is not None:
            addends = [jnp.stack([corner.weight * d for d in d_values], axis=-1) for corner in lookup.corners]
            d_texels = jnp.stack([corner.texel for corner in lookup.corners]), jnp.stack(addends)
        return *state, (d_splats, d_probe, d_texels)


def _has_splats_left(ends: Array, carry: tuple[Any, ...]) -> Array:
    """Return whether a tile of a group has splats left, and live pixels."""
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def _numbers_of(tile: Tiles) -> pixel.TileNumbers:
    """Return the centre of one tile, and its frame if pixels have rays of their own."""
    return tile.x, tile.y, *(() if tile.pixels is None else tile.pixels.frames.reshape(4))


def _split(splats: Splats, has_geometry: bool) -> pixel.Splat:
    """Split splats [B, ...] into numbers for `pixel`, each [B]."""

    def columns(x: Array) -> Any:
        return tuple(x[:, k] for k in range(x.shape[1]))

    M: Any = tuple(columns(splats.M[:, i]) for i in range(3))
    normal = columns(splats.normals) if has_geometry else None
    return pixel.Splat(M, splats.opacities, columns(splats.colors), normal, columns(splats.numbers))


def _values_of(lookup: Lookup | None) -> tuple[Array, ...]:
    return () if lookup is None else lookup.sample.values


def _composited(
    alphas: Array, channels: tuple[Array, ...], transmittance: Array, is_live: Array
) -> tuple[Array, Array, Array]:
    """Composite alphas [B, P] and channels [B, P] of a block; the rest is as for `_TracedPass.block`."""

    def add_splat(carry: tuple[Array, Array], alpha: Array) -> tuple[tuple[Array, Array], Array]:
        weight, transmittance, is_live = pixel.absorb(alpha, *carry)
        return (transmittance, is_live), weight

    def sum_rows(x: Array) -> Array:
        # By halves: a reduction of the first axis would not be vectorised over pixels.
        while x.shape[0] > 1:
            x = x[: x.shape[0] // 2] + x[x.shape[0] // 2 :]
        return x[0]

    (transmittance, is_live), weights = jax.lax.scan(add_splat, (transmittance, is_live), alphas)
    return jnp.stack([sum_rows(channel * weights) for channel in channels]), transmittance, is_live
