"""Forward and backward pass over tiles, splats and pixels, around the functions of `pixel`.

One call composites the tiles first..last − 1. Every splat of a tile's list is prepared once (scalar code), then applied
to the tile's pixels, L at a time (vector code). A vector of which the splat reaches no pixel is skipped.

    forward(ids, starts, splats, regions, texels, pixels, result; first, last, columns, width, height)
    backward(ids, starts, splats, regions, texels, pixels, g, suffix_sum, jacobian, d_splats, d_texels, d_probe,
             places, more_splats, more_texels, more_probe, more_first; the same)

Buffers: ids [pairs], starts [tiles + 1], splats [N, S] packed (`num_floats`), regions [N, 3], texels [T, C],
pixels (`packed_pixels`) of cameras with rays,
result [tiles, D + 1, P] channels and transmittance, g [tiles, D, P], suffix_sum [tiles, P], jacobian [3, 3];
the pass adds to d_splats [N, S], d_texels [T, C] and d_probe [N, 4]. `places` [pairs] holds −1, or k if the splat's own
row belongs to another thread: the pair then adds to row k of more_splats and more_probe, and to more_texels from texel
more_first[k] on.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import llvm_modules
from a2tg_jax.rasterize.kernels.native.lanes import BOOL, INT, Lanes
from a2tg_jax.rasterize.kernels.native.llvm_modules import CompiledFunction
from a2tg_jax.rasterize.kernels.native.texels import NativeTexture, Place, TexelWriter
from a2tg_jax.rasterize.kernels.native.writer import LONG
from a2tg_jax.rasterize.kernels.traced import CUTOFF_SLACK, Functions
from a2tg_jax.rasterize.splats import KernelSpec
from a2tg_jax.rasterize.tile_pixels import TilePixels

INTEGERS = ("first", "last", "columns", "width", "height")
FORWARD = ("ids", "starts", "splats", "regions", "texels", "pixels", "result")
BACKWARD = (
    *(
        "ids",
        "starts",
        "splats",
        "regions",
        "texels",
        "pixels",
        "g",
        "suffix_sum",
        "jacobian",
        "d_splats",
        "d_texels",
        "d_probe",
    ),
    *("places", "more_splats", "more_texels", "more_probe", "more_first"),
)


def pixel_order(tile_size: int, lanes: int) -> np.ndarray:
    """Return the pixels of a tile, counted row by row, in the order in which vectors take them.

    If blocks of L pixels fill the tile, each vector takes one: a compact block sees fewer splats and texels than a row.
    """
    height = 1 << (lanes.bit_length() - 1) // 2
    width = lanes // height
    pixels = np.arange(tile_size**2).reshape(tile_size, tile_size)
    if tile_size % height or tile_size % width:
        return pixels.reshape(-1)
    blocks = pixels.reshape(tile_size // height, height, tile_size // width, width)
    return np.moveaxis(blocks, 2, 1).reshape(-1)


def packed_pixels(spec: KernelSpec, pixels: TilePixels | None, dtype: DTypeLike) -> Array:
    """Pack the pixels of each tile as a row: its numbers, then x, y and whether they are seen, in the order of vectors.

    All four parts fill whole vectors. Without rays, the result is empty.
    """
    if pixels is None:
        return jnp.zeros((1, 0), dtype)
    lanes = num_lanes(spec)
    order = pixel_order(spec.tile_size, lanes)
    numbers = jnp.concatenate([pixels.centers, pixels.frames.reshape(-1, 4)], axis=1)
    x, y = (pixels.offsets[:, k, order] for k in range(2))
    parts = numbers, x, y, pixels.is_seen[:, order].astype(dtype)
    return jnp.concatenate([jnp.pad(part, ((0, 0), (0, -part.shape[1] % lanes))) for part in parts], axis=1)


def num_lanes(spec: KernelSpec) -> int:
    """Return the number of pixels of a vector."""
    return llvm_modules.vector_bytes() // np.dtype(spec.dtype).itemsize


class _LoadedSplat(NamedTuple):
    """Splat prepared for the pixels of a tile."""

    numbers: list[ir.Value]
    """Numbers as in memory, without the cutoff."""
    planes: list[ir.Value]
    """`rasterize.pixel.Planes`, the same in every lane."""
    spread: list[ir.Value]
    """`numbers` in every lane."""
    texture: NativeTexture | None
    """Its texture, if the appearance has textures."""
    spread_region: list[ir.Value]
    """`TextureRegion` in every lane."""
    limit: ir.Value
    """Squared distance within which a pixel is composited, in every lane."""


class _Rows(NamedTuple):
    """Addresses to which the cotangents of a splat are added."""

    splat: ir.Value
    """Row of its numbers."""
    probe: ir.Value
    """Row of the statistic."""
    texture: NativeTexture | None
    """Cotangents of its texels, if the appearance has textures."""


TileValues = list[ir.Value]
"""Numbers of a tile (`rasterize.pixel.TileNumbers`)."""
Composite = Callable[[ir.Value, ir.Value, ir.Value, Place | None, ir.Value], None]
"""Function (k, x, y, place, is_live) that composites a splat on vector k; `place` is the position of its lookup."""


class _Pass(TexelWriter):
    """Base of both passes."""

    def __init__(self, spec: KernelSpec, functions: Functions, module: ir.Module, name: str, buffers: Sequence[str]):
        super().__init__(module, name, buffers, INTEGERS, spec.dtype)
        self.spec, self.functions, self.num_columns = spec, functions, spec.num_columns
        self.empty = spec.static.functions.empty
        self.lanes, self.scalars = Lanes(self.b, num_lanes(spec)), Lanes(self.b, 1)
        self.num_vectors = -(-(spec.tile_size**2) // self.lanes.width)
        self.reals = self.lanes.vector(self.real)
        self.integers = self.lanes.vector(INT)
        order = pixel_order(spec.tile_size, self.lanes.width)
        y, x = np.stack(np.divmod(order, spec.tile_size)) - (spec.tile_size - 1) / 2
        # Lanes past the last pixel lie outside every image.
        past = np.full(-len(order) % self.lanes.width, 1e9)
        self.transmittance = self.variable(self.reals, self.num_vectors)
        self.live = self.variable(self.integers, self.num_vectors)
        self.pixel_x = self._constants(f"{name}.x", self.real, [*x, *past])
        self.pixel_y = self._constants(f"{name}.y", self.real, [*y, *past])
        self.order = self._constants(f"{name}.order", INT, order)

    def _constants(self, name: str, type_: ir.Type, numbers: Sequence[float] | np.ndarray) -> ir.Value:
        """Add a table of constants to the module; return its address."""
        array = ir.Constant(ir.ArrayType(type_, len(numbers)), np.asarray(numbers).tolist())
        table = ir.GlobalVariable(self.b.module, array.type, name)
        table.initializer, table.global_constant, table.align = array, True, llvm_modules.vector_bytes()
        table.type = ir.PointerType()
        return table

    def all_tiles(self, composite_tile: Callable[[ir.Value, TileValues], None]) -> None:
        """Write a loop of composite_tile(tile, numbers) over the tiles, and end the function."""
        given = self.arguments
        with self.loop(self.long(given["first"]), self.long(given["last"])) as (tile, _):
            composite_tile(tile, self._tile_with_rays(tile) if self.spec.has_rays else self._tile_center(tile))
        self.b.ret_void()

    def _tile_center(self, tile: ir.Value) -> TileValues:
        """Return the centre of a tile of a pinhole camera."""
        b, size = self.b, self.spec.tile_size
        columns = self.long(self.arguments["columns"])
        place = b.srem(tile, columns), b.sdiv(tile, columns)
        return [b.fadd(b.fmul(b.sitofp(at, self.real), self.real(size)), self.real(size / 2)) for at in place]

    def _tile_with_rays(self, tile: ir.Value) -> TileValues:
        """Take the pixels of a tile from the buffer (`packed_pixels`); return its numbers."""
        width, num = self.lanes.width, self.spec.num_tile_numbers
        header, part = -(-num // width) * width, self.num_vectors * width
        base = self.at(self.arguments["pixels"], self.times(tile, header + 3 * part), self.real)
        parts = (self.at(base, LONG(header + k * part), self.real) for k in range(3))
        self.pixel_x, self.pixel_y, self.is_seen = parts
        return [self.load(base, LONG(k), self.real) for k in range(num)]

    def all_splats(self, tile: ir.Value, each_splat: Callable[[ir.Value, ir.Value], ir.Value]) -> None:
        """Write a loop of each_splat(id, position) over a tile's list, until it returns that no pixel is live."""
        starts, b = self.arguments["starts"], self.b
        first, last = (self.long(self.load(starts, b.add(tile, LONG(k)), INT)) for k in (0, 1))
        with self.loop(first, last) as (position, done):
            is_live = each_splat(self.long(self.load(self.arguments["ids"], position, INT)), position)
            going_on = b.append_basic_block("on")
            b.cbranch(is_live, going_on, done)
            b.position_at_end(going_on)

    def all_vectors(self) -> contextlib.AbstractContextManager[tuple[ir.Value, ir.Block]]:
        """Write a loop over the vectors of a tile."""
        return self.loop(LONG(0), LONG(self.num_vectors))

    def live_at_first(self, index: ir.Value, tile: TileValues) -> ir.Value:
        """Return whether the pixels of a vector lie inside the image and have a ray, as 0 or 1."""
        b, inside = self.b, []
        if self.spec.has_rays:
            seen = self.load(self.is_seen, index, self.reals)
            return b.zext(b.fcmp_ordered(">", seen, self.lanes.constant(0.5, self.real)), self.integers)
        tile_x, tile_y = tile
        for table, center, size in ((self.pixel_x, tile_x, "width"), (self.pixel_y, tile_y, "height")):
            at = b.fadd(self.load(table, index, self.reals), self.lanes.broadcast(center))
            limit = self.lanes.broadcast(b.sitofp(self.arguments[size], self.real))
            inside.append(b.fcmp_ordered("<", at, limit))
        return b.zext(b.and_(*inside), self.integers)

    def pixel(self, k: ir.Value, channel: int) -> ir.Value:
        """Return the index of a tile's lane k among its numbers [channels, P]."""
        return self.b.add(self.long(self.load(self.order, k, INT)), LONG(channel * self.spec.tile_size**2))

    def begin_tile(self, tile: TileValues) -> None:
        """Set the transmittance to 1, and the pixels inside the image live."""
        with self.all_vectors() as (k, _):
            self.store(self.lanes.constant(1.0, self.real), self.transmittance, k)
            self.store(self.live_at_first(k, tile), self.live, k)

    def load_splat(self, id_: ir.Value, tile: TileValues) -> _LoadedSplat:
        """Load a splat of the list and prepare it for a tile."""
        *numbers, cutoff = self.splat_numbers(id_)
        planes = self.scalars.emit(self.functions.prepare, [*numbers[:9], *tile])
        limit = self.b.fadd(cutoff, self.real(CUTOFF_SLACK))
        region = self.region_numbers(id_)
        spread = self.spread(planes), self.spread(numbers)
        texture = self.texture(self.arguments["texels"], *map(self.long, region)) if region else None
        return _LoadedSplat(numbers, *spread, texture, self.spread(region), self.lanes.broadcast(limit))

    def reached_vectors(self, splat: _LoadedSplat, composite: Composite) -> ir.Value:
        """Composite a splat on the vectors of pixels that it may reach; return whether a pixel is still live."""
        b, lanes = self.b, self.lanes
        none = lanes.constant(0, INT)
        any_live = self.variable(self.integers)
        b.store(none, any_live)
        with self.all_vectors() as (k, _):
            x, y = self.load(self.pixel_x, k, self.reals), self.load(self.pixel_y, k, self.reals)
            rho, *position = lanes.emit(self.functions.reach, [*splat.planes, *splat.spread_region, x, y])
            is_live = b.icmp_signed("!=", self.load(self.live, k, self.integers), none)
            is_reached = b.and_(is_live, b.fcmp_ordered("<=", rho, splat.limit))
            with b.if_then(lanes.any(is_reached)):
                composite(k, x, y, Place(position[0], position[1], is_reached) if position else None, is_live)
            now = self.load(self.live, k, self.integers)
            b.store(b.or_(now, b.load(any_live, typ=self.integers)), any_live)
        return lanes.any(b.icmp_signed("!=", b.load(any_live, typ=self.integers), none))

    def splat_numbers(self, id_: ir.Value) -> list[ir.Value]:
        """Load the S numbers of a splat."""
        base = self.at(self.arguments["splats"], self.times(id_, self.spec.num_floats), self.real)
        return [self.load(base, k, self.real) for k in range(self.spec.num_floats)]

    def region_numbers(self, id_: ir.Value) -> list[ir.Value]:
        """Load the region of a splat's texture; empty without textures."""
        base = self.at(self.arguments["regions"], self.times(id_, 3), INT)
        return [self.load(base, k, INT) for k in range(3)] if self.num_columns else []

    def spread(self, numbers: Sequence[ir.Value]) -> list[ir.Value]:
        """Copy numbers to every lane."""
        return [self.lanes.broadcast(number) for number in numbers]


class _Forward(_Pass):
    """Pass that computes channels and transmittance of the tiles."""

    def write(self) -> None:
        """Write the function."""
        channels = [self.variable(self.reals, self.num_vectors) for _ in range(self.spec.num_channels)]

        def composite_tile(index: ir.Value, tile: TileValues) -> None:
            self.begin_tile(tile)
            with self.all_vectors() as (k, _):
                for channel in channels:
                    self.store(self.lanes.constant(0.0, self.real), channel, k)
            self.all_splats(index, functools.partial(self.splat, tile, channels))
            self.write_tile(index, [*channels, self.transmittance])

        self.all_tiles(composite_tile)

    def splat(self, tile: TileValues, channels: Sequence[ir.Value], id_: ir.Value, _: ir.Value) -> ir.Value:
        """Add one splat to a tile; return whether a pixel is still live."""
        splat = self.load_splat(id_, tile)

        def composite(k: ir.Value, x: ir.Value, y: ir.Value, place: Place | None, is_live: ir.Value) -> None:
            values = self.sample(splat.texture, place, has_slopes=False) if splat.texture and place else []
            state = [
                self.load(self.transmittance, k, self.reals),
                is_live,
                *(self.load(c, k, self.reals) for c in channels),
            ]
            at_pixel = [*splat.planes, *splat.spread, *values, x, y, *state]
            after, still_live, *totals = self.lanes.emit(self.functions.forward, at_pixel)
            self.store(after, self.transmittance, k)
            self.store(self.b.zext(still_live, self.integers), self.live, k)
            for total, channel in zip(totals, channels, strict=True):
                self.store(total, channel, k)

        return self.reached_vectors(splat, composite)

    def write_tile(self, tile: ir.Value, arrays: Sequence[ir.Value]) -> None:
        """Store the numbers of a tile in `result`."""
        num_pixels = self.spec.tile_size**2
        base = self.at(self.arguments["result"], self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(array, k, self.real), base, self.pixel(k, index))


class _Backward(_Pass):
    """Pass that computes cotangents of the splats and of the texels, and the statistic."""

    def write(self) -> None:
        """Write the function."""
        suffix_sum, *g = (self.variable(self.reals, self.num_vectors) for _ in range(1 + self.spec.num_channels))
        self.sums = self.variable(self.reals, self.num_sums)
        for k in range(self.num_sums):
            self.store(self.lanes.constant(0.0, self.real), self.sums, k)

        def composite_tile(index: ir.Value, tile: TileValues) -> None:
            self.begin_tile(tile)
            self.read_tile(index, [suffix_sum], self.arguments["suffix_sum"])
            self.read_tile(index, g, self.arguments["g"])
            self.all_splats(index, functools.partial(self.splat, tile, suffix_sum, g))

        self.all_tiles(composite_tile)

    def read_tile(self, tile: ir.Value, arrays: Sequence[ir.Value], source: ir.Value) -> None:
        """Load the numbers of a tile from a buffer."""
        num_pixels = self.spec.tile_size**2
        base = self.at(source, self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            with self.loop(LONG(num_pixels), LONG(self.num_vectors * self.lanes.width)) as (k, _):
                self.store(self.real(0.0), array, k)
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(base, self.pixel(k, index), self.real), array, k)

    def splat(
        self, tile: TileValues, suffix_sum: ir.Value, g: Sequence[ir.Value], id_: ir.Value, position: ir.Value
    ) -> ir.Value:
        """Add the cotangents of one splat in a tile; return whether a pixel is still live."""
        b, lanes, spec = self.b, self.lanes, self.spec
        splat, zero = self.load_splat(id_, tile), self.lanes.constant(0.0, self.real)
        tile_numbers = self.spread(tile)
        jacobian = self.spread([self.load(self.arguments["jacobian"], k, self.real) for k in range(9)])
        rows = self.rows_of(id_, position, splat.texture)
        any_contributes = self.variable(BOOL)
        b.store(BOOL(0), any_contributes)
        num_sums = self.functions.num_planes + (len(splat.numbers) - 9) + (4 if spec.statistic else 0)
        totals = self.zeros(num_sums)

        def composite(k: ir.Value, x: ir.Value, y: ir.Value, place: Place | None, is_live: ir.Value) -> None:
            sample = self.sample(splat.texture, place, has_slopes=True) if splat.texture and place else []
            state = [self.load(self.transmittance, k, self.reals), is_live, self.load(suffix_sum, k, self.reals)]
            cotangents = [self.load(channel, k, self.reals) for channel in g]
            at_pixel = [*splat.planes, *splat.spread, *splat.spread_region, *sample, x, y]
            at_pixel += [*state, *cotangents, *tile_numbers, *jacobian]
            after, still_live, left, contributes, *rest = lanes.emit(self.functions.backward, at_pixel)
            self.store(after, self.transmittance, k)
            self.store(b.zext(still_live, self.integers), self.live, k)
            self.store(left, suffix_sum, k)
            d_values, sums = rest[: self.num_columns], rest[self.num_columns :]
            if spec.statistic:
                sums.append(lanes.constant(1.0, self.real))
            # Selected, not multiplied: the cotangents of a pixel that shows nothing may not be finite.
            chosen = functools.partial(b.select, contributes, rhs=zero)
            with b.if_then(lanes.any(contributes)):
                b.store(BOOL(1), any_contributes)
                for total, value in zip(totals, sums, strict=True):
                    b.store(b.fadd(b.load(total, typ=self.reals), chosen(value)), total)
                if rows.texture and place:
                    self.add_to_texels(rows.texture, place, [chosen(value) for value in d_values])

        is_live = self.reached_vectors(splat, composite)
        with b.if_then(b.load(any_contributes, typ=BOOL)):
            self.add_totals(rows, splat.numbers, tile, totals)
            if rows.texture:
                self.finish_texels(rows.texture)
        return is_live

    def rows_of(self, id_: ir.Value, position: ir.Value, texture: NativeTexture | None) -> _Rows:
        """Return the addresses to which the cotangents of one pair are added."""
        b, arguments = self.b, self.arguments
        place = self.long(self.load(arguments["places"], position, INT))
        is_own = b.icmp_signed("<", place, LONG(0))
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
        return _Rows(at_row(splats, self.times(row, self.spec.num_floats)), at_row(probe, self.times(row, 4)), texture)

    def add_totals(
        self, rows: _Rows, numbers: Sequence[ir.Value], tile: TileValues, totals: Sequence[ir.Value]
    ) -> None:
        """Sum over lanes, carry the planes' cotangents to the homography, and add all to the splat's rows."""
        spec, functions = self.spec, self.functions
        sums = [self.lanes.sum(self.b.load(total, typ=self.reals)) for total in totals]
        d_planes, others = sums[: functions.num_planes], sums[functions.num_planes :]
        d_M = self.scalars.emit(functions.prepare_vjp, [*numbers[:9], *tile, *d_planes])
        num_others = len(numbers) - 9
        self.add(rows.splat, [*d_M, *others[:num_others]])
        if spec.statistic:
            self.add(rows.probe, others[num_others:])

    def add(self, base: ir.Value, values: Sequence[ir.Value]) -> None:
        """Add values to a row."""
        for k, value in enumerate(values):
            self.store(self.b.fadd(self.load(base, k, self.real), value), base, k)


@dataclasses.dataclass(frozen=True)
class Passes:
    """Compiled forward and backward pass."""

    forward: CompiledFunction
    backward: CompiledFunction


@functools.cache
def compiled_passes(spec: KernelSpec) -> Passes:
    """Return the passes of a spec, compiled at the first call."""
    functions = Functions(spec)
    module = ir.Module("passes")
    forward, backward = (llvm_modules.unique(name) for name in ("forward", "backward"))
    _Forward(spec, functions, module, forward, FORWARD).write()
    _Backward(spec, functions, module, backward, BACKWARD).write()
    addresses = llvm_modules.compile_module(module)
    return Passes(
        forward=llvm_modules.as_function(addresses[forward], len(FORWARD), len(INTEGERS)),
        backward=llvm_modules.as_function(addresses[backward], len(BACKWARD), len(INTEGERS)),
    )
