"""Forward and backward pass over tiles, splats and pixels, around the functions of `pixel`.

One call composites the tiles first..last − 1. Every splat of a tile's list is prepared once (scalar code), then applied
to the tile's pixels, L at a time (vector code). A vector of which the splat reaches no pixel is skipped.

    forward(ids, starts, splats, regions, texels, pixels, result; first, last, columns, width, height)
    backward(ids, starts, splats, regions, texels, pixels, g, suffix_sum, jacobian, d_splats, d_texels, d_probe,
             places, more_splats, more_texels, more_probe, more_first; the same)

Buffers: ids [pairs], starts [tiles + 1], splats [N, S] packed (`num_floats`), regions [N, 3], texels [T, C], pixels
(`packed_pixels`) of cameras with rays, result [tiles, D + 1, P] channels and transmittance, g [tiles, D, P], suffix_sum
[tiles, P], jacobian [3, 3]; the pass adds to d_splats [N, S], d_texels [T, C] and d_probe [N, 4]. `places` [pairs]
holds −1, or k if the splat's own row belongs to another thread: the pair then adds to row k of more_splats and
more_probe, and to more_texels from texel more_first[k] on.
"""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import CUTOFF_SLACK, PixelFunctions
from a2tg_jax.rasterize.kernels.native import llvm_code
from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import BOOL, INT, LONG, CompiledFunction
from a2tg_jax.rasterize.kernels.native.texture_lookups import NativeTexture, Place, TexelWriter
from a2tg_jax.rasterize.splats import PassSettings
from a2tg_jax.rasterize.tile_pixels import TilePixels

INTEGERS = ("first", "last", "columns", "width", "height")
FORWARD = ("ids", "starts", "splats", "regions", "texels", "pixels", "result")
BACKWARD = (
    *(*FORWARD[:-1], "g", "suffix_sum", "jacobian", "d_splats", "d_texels", "d_probe"),
    *("places", "more_splats", "more_texels", "more_probe", "more_first"),
)
# Several registers of most processors: some compute while results of others are awaited, and branches for many pixels
# are mostly predicted. With textures, one register is faster (experiments/NOTEBOOK.md, "Speed on CPUs").
FORWARD_BYTES = llvm_code.ALIGNMENT
"""Size of the vectors of float32 in the forward pass."""
BACKWARD_BYTES = 64
"""Size of the vectors of float32 in the backward pass."""


def lanes_of(settings: PassSettings, vector_bytes: int) -> int:
    """Return the number L of pixels of a pass's vectors."""
    in_register = llvm_code.num_lanes(settings.dtype)
    itemsize = np.dtype(settings.dtype).itemsize
    # In float64, exp is called lane by lane, also for lanes that are not reached.
    if settings.num_values or itemsize > 4:
        return in_register
    lanes = vector_bytes // itemsize
    # Vectors that do not divide the tile would compute pixels that do not exist.
    while settings.num_pixels % lanes:
        lanes //= 2
    return max(in_register, lanes)


def pixel_order(tile_size: int, lanes: int) -> np.ndarray:
    """Return the pixels of a tile, counted row by row, in the order in which vectors take them.

    If blocks of L pixels fill the tile, each vector takes one: a compact block sees fewer splats and texels than a row.
    """
    # L = 2ᵏ lanes: 2^⌊k/2⌋ rows, as 2×4 for 8 lanes.
    height = 1 << (lanes.bit_length() - 1) // 2
    width = lanes // height
    pixels = np.arange(tile_size**2).reshape(tile_size, tile_size)
    if tile_size % height or tile_size % width:
        return pixels.reshape(-1)
    blocks = pixels.reshape(tile_size // height, height, tile_size // width, width)
    return np.moveaxis(blocks, 2, 1).reshape(-1)


def packed_pixels(settings: PassSettings, pixels: TilePixels | None, vector_bytes: int) -> Array:
    """Pack the pixels of each tile as a row: its numbers, then x, y and whether they are seen, in the order of vectors.

    All four parts fill whole vectors. Without rays, the result is empty.
    """
    if pixels is None:
        return jnp.zeros((1, 0), settings.dtype)
    lanes = lanes_of(settings, vector_bytes)
    order = pixel_order(settings.grid.tile_size, lanes)
    numbers = jnp.concatenate([pixels.centers, pixels.frames.reshape(-1, 4)], axis=1)
    x = pixels.offsets[:, 0, order]
    y = pixels.offsets[:, 1, order]
    parts = numbers, x, y, pixels.is_seen[:, order].astype(settings.dtype)
    return jnp.concatenate([jnp.pad(part, ((0, 0), (0, -part.shape[1] % lanes))) for part in parts], axis=1)


class _LoadedSplat(NamedTuple):
    numbers: list[ir.Value]  # numbers as in memory, without the cutoff
    planes: list[ir.Value]  # `rasterize.pixel.Planes`, the same in every lane
    spread: list[ir.Value]  # `numbers` in every lane
    texture: NativeTexture | None  # its texture, if the appearance has textures
    spread_region: list[ir.Value]  # `TextureRegion` in every lane
    limit: ir.Value  # squared distance within which a pixel is composited, in every lane


class _Vector(NamedTuple):
    k: ir.Value  # its number in the tile
    x: ir.Value  # horizontal coordinates from the tile's centre
    y: ir.Value  # vertical coordinates
    place: Place | None  # positions in the splat's texture, if it has one
    is_live: ir.Value  # pixels that have not stopped


class _Pass(TexelWriter):
    """Base of both passes. Generators write a loop, or a branch, which the body of the caller's `for` fills."""

    vector_bytes: ClassVar[int]

    def __init__(self, functions: PixelFunctions, module: ir.Module, name: str, buffers: Sequence[str]):
        settings = functions.settings
        super().__init__(module, name, buffers, INTEGERS, settings.dtype)
        self.settings = settings
        self.functions = functions
        self.num_values = settings.num_values
        self.empty = settings.static.functions.empty
        self.tile_size = settings.grid.tile_size
        self.lanes = Lanes(self.b, lanes_of(settings, self.vector_bytes))
        self.scalars = Lanes(self.b, 1)
        self.num_vectors = -(-settings.num_pixels // self.lanes.width)
        self.reals = self.lanes.vector(self.real)
        self.integers = self.lanes.vector(INT)
        order = pixel_order(self.tile_size, self.lanes.width)
        y, x = np.stack(np.divmod(order, self.tile_size)) - (self.tile_size - 1) / 2
        # Lanes past the last pixel are outside every image.
        past = np.full(-len(order) % self.lanes.width, 1e9)
        self.transmittance = self.variable(self.reals, self.num_vectors)
        self.live = self.variable(self.integers, self.num_vectors)
        self.any_live = self.variable(self.integers)
        self.pixel_x = self._constants(f"{name}.x", self.real, [*x, *past])
        self.pixel_y = self._constants(f"{name}.y", self.real, [*y, *past])
        # Pixels in memory are row by row.
        self.order = self._constants(f"{name}.order", INT, order)

    def _constants(self, name: str, type_: ir.Type, numbers: Sequence[float] | np.ndarray) -> ir.Value:
        """Add a table of constants to the module; return its address."""
        array = ir.Constant(ir.ArrayType(type_, len(numbers)), np.asarray(numbers).tolist())
        table = ir.GlobalVariable(self.b.module, array.type, name)
        table.initializer = array
        table.global_constant = True
        table.align = llvm_code.ALIGNMENT
        table.type = ir.PointerType()
        return table

    def tiles(self) -> Iterator[tuple[ir.Value, list[ir.Value]]]:
        """Write a loop over the tiles; yield each one's index and `rasterize.pixel.TileNumbers`. Then end the
        function."""
        b = self.b
        arguments = self.arguments
        size = self.tile_size
        with self.loop(self.long(arguments["first"]), self.long(arguments["last"])) as (tile, _):
            if self.settings.has_rays:
                yield tile, self._tile_with_rays(tile)
            else:
                columns = self.long(arguments["columns"])
                place = b.srem(tile, columns), b.sdiv(tile, columns)
                scaled = (b.fmul(b.sitofp(at, self.real), self.real(size)) for at in place)
                yield tile, [b.fadd(corner, self.real(size / 2)) for corner in scaled]
        b.ret_void()

    def _tile_with_rays(self, tile: ir.Value) -> list[ir.Value]:
        """Take the pixels of a tile from the buffer (`packed_pixels`); return its numbers."""
        width = self.lanes.width
        num = self.functions.num_tile_numbers
        # Each part fills whole vectors, as `packed_pixels` has padded it.
        header = -(-num // width) * width
        part = self.num_vectors * width
        base = self.at(self.arguments["pixels"], self.times(tile, header + 3 * part), self.real)
        parts = (self.at(base, LONG(header + k * part), self.real) for k in range(3))
        self.pixel_x, self.pixel_y, self.is_seen = parts
        return [self.load(base, LONG(k), self.real) for k in range(num)]

    def splats(self, tile: ir.Value) -> Iterator[tuple[ir.Value, ir.Value]]:
        """Write a loop over a tile's list, until no pixel is live; yield each splat's id, and position in `ids`."""
        starts = self.arguments["starts"]
        b = self.b
        first = self.long(self.load(starts, b.add(tile, LONG(0)), INT))
        last = self.long(self.load(starts, b.add(tile, LONG(1)), INT))
        with self.loop(first, last) as (position, done):
            yield self.long(self.load(self.arguments["ids"], position, INT)), position
            going_on = b.append_basic_block("on")
            is_live = b.icmp_signed("!=", b.load(self.any_live, typ=self.integers), self.lanes.constant(0, INT))
            b.cbranch(self.lanes.any(is_live), going_on, done)
            b.position_at_end(going_on)

    def all_vectors(self) -> contextlib.AbstractContextManager[tuple[ir.Value, ir.Block]]:
        return self.loop(LONG(0), LONG(self.num_vectors))

    def pixel(self, k: ir.Value, channel: int) -> ir.Value:
        """Return the index of a tile's lane k among its numbers [channels, P]."""
        return self.b.add(self.long(self.load(self.order, k, INT)), LONG(channel * self.settings.num_pixels))

    def begin_tile(self, tile: list[ir.Value]) -> None:
        """Set the transmittance to 1, and the pixels live that are inside the image and have a ray."""
        b = self.b
        lanes = self.lanes
        with self.all_vectors() as (k, _):
            self.store(lanes.constant(1.0, self.real), self.transmittance, k)
            if self.settings.has_rays:
                is_seen = self.load(self.is_seen, k, self.reals)
                is_live = b.fcmp_ordered(">", is_seen, lanes.constant(0.5, self.real))
            else:
                inside = []
                for table, center, size in zip((self.pixel_x, self.pixel_y), tile, ("width", "height"), strict=True):
                    at = b.fadd(self.load(table, k, self.reals), lanes.broadcast(center))
                    limit = lanes.broadcast(b.sitofp(self.arguments[size], self.real))
                    inside.append(b.fcmp_ordered("<", at, limit))
                is_live = b.and_(*inside)
            self.store(b.zext(is_live, self.integers), self.live, k)

    def load_splat(self, id_: ir.Value, tile: list[ir.Value]) -> _LoadedSplat:
        """Load a splat of the list and prepare it for a tile."""
        num_floats = self.settings.num_floats
        arguments = self.arguments
        row = self.at(arguments["splats"], self.times(id_, num_floats), self.real)
        *numbers, cutoff = (self.load(row, k, self.real) for k in range(num_floats))
        planes = self.scalars.emit(self.functions.prepare, [*numbers[:9], *tile])
        limit = self.b.fadd(cutoff, self.real(CUTOFF_SLACK))
        region_row = self.at(arguments["regions"], self.times(id_, 3), INT)
        region = [self.load(region_row, k, INT) for k in range(3)] if self.num_values else []
        texture = self.texture(arguments["texels"], *map(self.long, region)) if region else None
        spread = self.spread(planes), self.spread(numbers)
        return _LoadedSplat(numbers, *spread, texture, self.spread(region), self.lanes.broadcast(limit))

    def reached_vectors(self, splat: _LoadedSplat) -> Iterator[_Vector]:
        """Write a loop over the vectors of pixels that a splat may reach; gather in `any_live` which are live after."""
        b = self.b
        lanes = self.lanes
        none = lanes.constant(0, INT)
        b.store(none, self.any_live)
        with self.all_vectors() as (k, _):
            x = self.load(self.pixel_x, k, self.reals)
            y = self.load(self.pixel_y, k, self.reals)
            rho, *position = lanes.emit(self.functions.reach, [*splat.planes, *splat.spread_region, x, y])
            is_live = b.icmp_signed("!=", self.load(self.live, k, self.integers), none)
            # An unordered ρ is not reached: NaN fails every comparison.
            is_reached = b.and_(is_live, b.fcmp_ordered("<=", rho, splat.limit))
            with b.if_then(lanes.any(is_reached)):
                yield _Vector(k, x, y, Place(position[0], position[1], is_reached) if position else None, is_live)
            still_live = self.load(self.live, k, self.integers)
            b.store(b.or_(still_live, b.load(self.any_live, typ=self.integers)), self.any_live)

    def spread(self, numbers: Sequence[ir.Value]) -> list[ir.Value]:
        return [self.lanes.broadcast(number) for number in numbers]

    def store_state(self, k: ir.Value, transmittance: ir.Value, is_live: ir.Value) -> None:
        self.store(transmittance, self.transmittance, k)
        self.store(self.b.zext(is_live, self.integers), self.live, k)


class _Forward(_Pass):
    """Pass that computes channels and transmittance of the tiles."""

    vector_bytes = FORWARD_BYTES

    def write(self) -> None:
        channels = [self.variable(self.reals, self.num_vectors) for _ in range(self.settings.num_channels)]
        for tile, tile_numbers in self.tiles():
            self.begin_tile(tile_numbers)
            with self.all_vectors() as (k, _):
                for channel in channels:
                    self.store(self.lanes.constant(0.0, self.real), channel, k)
            for id_, _ in self.splats(tile):
                splat = self.load_splat(id_, tile_numbers)
                for vector in self.reached_vectors(splat):
                    self.composite(splat, vector, channels)
            arrays = [*channels, self.transmittance]
            num_pixels = self.settings.num_pixels
            base = self.at(self.arguments["result"], self.times(tile, num_pixels * len(arrays)), self.real)
            for index, array in enumerate(arrays):
                with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                    self.store(self.load(array, k, self.real), base, self.pixel(k, index))

    def composite(self, splat: _LoadedSplat, vector: _Vector, channels: Sequence[ir.Value]) -> None:
        k = vector.k
        place = vector.place
        values = self.sample(splat.texture, place, has_slopes=False) if splat.texture and place else []
        colors = [self.load(channel, k, self.reals) for channel in channels]
        state = [self.load(self.transmittance, k, self.reals), vector.is_live, *colors]
        at_pixel = [*splat.planes, *splat.spread, *values, vector.x, vector.y, *state]
        transmittance, still_live, *totals = self.lanes.emit(self.functions.forward, at_pixel)
        self.store_state(k, transmittance, still_live)
        for total, channel in zip(totals, channels, strict=True):
            self.store(total, channel, k)


class _Backward(_Pass):
    """Pass that computes cotangents of the splats and of the texels, and the statistic."""

    vector_bytes = BACKWARD_BYTES

    def write(self) -> None:
        b = self.b
        settings = self.settings
        self.suffix_sum = self.variable(self.reals, self.num_vectors)
        self.g = [self.variable(self.reals, self.num_vectors) for _ in range(settings.num_channels)]
        self.sums = self.variable(self.reals, self.num_sums)
        for k in range(self.num_sums):
            self.store(self.lanes.constant(0.0, self.real), self.sums, k)
        self.any_contributes = self.variable(BOOL)
        for tile, tile_numbers in self.tiles():
            self.begin_tile(tile_numbers)
            self.read_tile(tile, [self.suffix_sum], self.arguments["suffix_sum"])
            self.read_tile(tile, self.g, self.arguments["g"])
            for id_, position in self.splats(tile):
                splat = self.load_splat(id_, tile_numbers)
                jacobian = [self.load(self.arguments["jacobian"], k, self.real) for k in range(9)]
                same_everywhere = self.spread([*tile_numbers, *jacobian])
                *rows, d_texture = self.rows_of(id_, position, splat.texture)
                b.store(BOOL(0), self.any_contributes)
                # Planes, all numbers but the homography, three of the statistic and the number of pixels.
                num_totals = self.functions.num_planes + (len(splat.numbers) - 9) + (4 if settings.statistic else 0)
                totals = self.zeros(num_totals)
                for vector in self.reached_vectors(splat):
                    self.pull_back(splat, vector, same_everywhere, totals, d_texture)
                # Sums over lanes take as long as a vector of pixels: once per splat and tile, and only if needed.
                with b.if_then(b.load(self.any_contributes, typ=BOOL)):
                    self.add_totals(rows, splat.numbers, tile_numbers, totals)
                    if d_texture:
                        self.finish_texels(d_texture)

    def read_tile(self, tile: ir.Value, arrays: Sequence[ir.Value], source: ir.Value) -> None:
        num_pixels = self.settings.num_pixels
        base = self.at(source, self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            # Lanes past the last pixel are never live, but are computed: they must not hold NaN from another tile.
            with self.loop(LONG(num_pixels), LONG(self.num_vectors * self.lanes.width)) as (k, _):
                self.store(self.real(0.0), array, k)
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(base, self.pixel(k, index), self.real), array, k)

    def pull_back(
        self, splat: _LoadedSplat, vector: _Vector, same_everywhere: Sequence[ir.Value], totals: Sequence[ir.Value],
        d_texture: NativeTexture | None,
    ) -> None:  # fmt: skip
        """Add the cotangents of a splat at a vector of pixels to the totals, and its texels' to theirs."""
        b = self.b
        lanes = self.lanes
        k = vector.k
        place = vector.place
        sample = self.sample(splat.texture, place, has_slopes=True) if splat.texture and place else []
        transmittance = self.load(self.transmittance, k, self.reals)
        suffix_sum = self.load(self.suffix_sum, k, self.reals)
        cotangents = [self.load(array, k, self.reals) for array in self.g]
        at_pixel = [*splat.planes, *splat.spread, *splat.spread_region, *sample, vector.x, vector.y]
        at_pixel += [transmittance, vector.is_live, suffix_sum, *cotangents, *same_everywhere]
        transmittance, still_live, suffix_sum, contributes, *rest = lanes.emit(self.functions.backward, at_pixel)
        self.store_state(k, transmittance, still_live)
        self.store(suffix_sum, self.suffix_sum, k)
        d_values = rest[: self.num_values]
        sums = rest[self.num_values :]
        if self.settings.statistic:
            sums.append(lanes.constant(1.0, self.real))
        # Selected, not multiplied: the cotangents of a pixel that shows nothing may not be finite.
        chosen = functools.partial(b.select, contributes, rhs=lanes.constant(0.0, self.real))
        with b.if_then(lanes.any(contributes)):
            b.store(BOOL(1), self.any_contributes)
            for total, value in zip(totals, sums, strict=True):
                b.store(b.fadd(b.load(total, typ=self.reals), chosen(value)), total)
            if d_texture and place:
                self.add_to_texels(d_texture, place, [chosen(value) for value in d_values])

    def rows_of(
        self, id_: ir.Value, position: ir.Value, texture: NativeTexture | None
    ) -> tuple[ir.Value, ir.Value, NativeTexture | None]:
        """Return the addresses to which a pair adds the cotangents of its splat's numbers, the statistic, and the
        cotangents of its texels, if the appearance has textures."""
        b = self.b
        arguments = self.arguments
        place = self.long(self.load(arguments["places"], position, INT))
        is_own = b.icmp_signed("<", place, LONG(0))
        # Selects of addresses, not a branch: the code that adds is there once.
        row = b.select(is_own, id_, place)
        splats, texels, probe = (
            b.select(is_own, arguments[f"d_{name}"], arguments[f"more_{name}"])
            for name in ("splats", "texels", "probe")
        )
        if texture:
            own_first = self.long(self.load(arguments["regions"], self.times(id_, 3), INT))
            more_first = self.long(self.load(arguments["more_first"], b.select(is_own, LONG(0), place), INT))
            texture = self.texture(texels, b.select(is_own, own_first, more_first), texture.height, texture.width)
        at_row = functools.partial(self.at, type_=self.real)
        floats = self.settings.num_floats
        return at_row(splats, self.times(row, floats)), at_row(probe, self.times(row, 4)), texture

    def add_totals(
        self, rows: Sequence[ir.Value], numbers: Sequence[ir.Value], tile: list[ir.Value], totals: Sequence[ir.Value]
    ) -> None:
        """Sum over lanes, carry the planes' cotangents to the homography, and add all to the splat's rows."""
        functions = self.functions
        sums = [self.lanes.sum(self.b.load(total, typ=self.reals)) for total in totals]
        d_planes = sums[: functions.num_planes]
        others = sums[functions.num_planes :]
        # All pixels of a tile share the planes: their cotangents are summed first, and pulled back to M once.
        d_M = self.scalars.emit(functions.prepare_vjp, [*numbers[:9], *tile, *d_planes])
        num_others = len(numbers) - 9
        # The statistic, if any, is behind the numbers of the splat.
        for row, values in zip(rows, ([*d_M, *others[:num_others]], others[num_others:]), strict=True):
            for k, value in enumerate(values):
                self.store(self.b.fadd(self.load(row, k, self.real), value), row, k)


@functools.cache
def compiled_passes(kernel: PassSettings) -> dict[str, CompiledFunction]:
    """Return the passes `forward` and `backward` of a kernel, compiled at the first call."""
    functions = PixelFunctions(kernel)
    module = ir.Module("passes")
    forward = llvm_code.unique("forward")
    backward = llvm_code.unique("backward")
    _Forward(functions, module, forward, FORWARD).write()
    _Backward(functions, module, backward, BACKWARD).write()
    signatures = {forward: (len(FORWARD), len(INTEGERS)), backward: (len(BACKWARD), len(INTEGERS))}
    return dict(zip(("forward", "backward"), llvm_code.compiled(module, signatures), strict=True))
