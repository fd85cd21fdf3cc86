"""Native loops over tiles, splats and pixels, around the functions of `pixel`.

One call composites the tiles `first` to `last`. Every splat of a tile's list is prepared once (scalar code), then
applied to the tile's pixels, L at a time (vector code). Where no pixel of the L can be reached, they are passed over.

    forward(ids, starts, splats, rows, table, image; first, last, columns, width, height, entries)
    backward(ids, starts, splats, rows, table, g, behind, jacobian, d_splats, d_table, d_tap; the same)

Buffers: ids [pairs], starts [tiles + 1], splats [N, S] packed (`num_floats`), rows [N, I], table [entries, C],
image [tiles, D + 1, P] channels and transmittance, g [tiles, D, P], behind [tiles, P], jacobian [3, 3];
d_splats [N, S], d_table [entries, C] and d_tap [N, 4] are added to.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from a2tg_jax.kernels import library
from a2tg_jax.kernels.functions import Functions, Kind
from a2tg_jax.kernels.lanes import BOOL, INT, Lanes
from a2tg_jax.kernels.table import TableWriter
from a2tg_jax.kernels.writer import LONG

INTEGERS = ("first", "last", "columns", "width", "height", "entries")
FORWARD = ("ids", "starts", "splats", "rows", "table", "image")
BACKWARD = ("ids", "starts", "splats", "rows", "table", "g", "behind", "jacobian", "d_splats", "d_table", "d_tap")
CUTOFF_SLACK = 1e-3
"""Added to the squared distance within which a pixel is looked at; what it shows is decided exactly."""


class _Compositing(TableWriter):
    """What both passes share."""

    def __init__(self, kind: Kind, functions: Functions, module: ir.Module, name: str, buffers: Sequence[str]):
        super().__init__(module, name, buffers, INTEGERS, kind.dtype)
        self.kind, self.functions, self.num_columns = kind, functions, kind.num_columns
        self.lanes, self.scalars = Lanes(self.b, kind.lanes), Lanes(self.b, 1)
        self.reals = self.lanes.vector(self.real)
        self.integers = self.lanes.vector(INT)
        pixels = np.zeros((2, kind.num_vectors * kind.lanes))
        pixels[:, : kind.tile_size**2] = np.mgrid[: kind.tile_size, : kind.tile_size].reshape(2, -1)
        pixels[:, : kind.tile_size**2] -= (kind.tile_size - 1) / 2
        # Lanes past the last pixel lie outside of every image.
        pixels[:, kind.tile_size**2 :] = 1e9
        self.pixel_y, self.pixel_x = (self._table(f"{name}.{k}", row) for k, row in zip("yx", pixels, strict=True))

    def _table(self, name: str, numbers) -> ir.Value:
        array = ir.Constant(ir.ArrayType(self.real, len(numbers)), [float(number) for number in numbers])
        table = ir.GlobalVariable(self.b.module, array.type, name)
        table.initializer, table.global_constant, table.align = array, True, library.vector_bytes()
        table.type = ir.PointerType()
        return table

    def all_tiles(self, composite_tile) -> None:
        """Calls composite_tile(tile, tile_x, tile_y) in a loop, and ends the function."""
        kind, b, given = self.kind, self.b, self.arguments
        with self.loop(self.long(given["first"]), self.long(given["last"])) as (tile, _):
            columns = self.long(given["columns"])
            place = b.srem(tile, columns), b.sdiv(tile, columns)
            center = [
                b.fadd(b.fmul(b.sitofp(index, self.real), self.real(kind.tile_size)), self.real(kind.tile_size / 2))
                for index in place
            ]
            composite_tile(tile, *center)
        b.ret_void()

    def all_splats(self, tile: ir.Value, each_splat) -> None:
        """Calls each_splat(id) for the tile's list, front to back, until it returns that no pixel is live."""
        starts, b = self.arguments["starts"], self.b
        first, last = (self.long(self.load(starts, b.add(tile, LONG(k)), INT)) for k in (0, 1))
        with self.loop(first, last) as (position, done):
            is_live = each_splat(self.long(self.load(self.arguments["ids"], position, INT)))
            going_on = b.append_basic_block("on")
            b.cbranch(is_live, going_on, done)
            b.position_at_end(going_on)

    def all_vectors(self):
        return self.loop(LONG(0), LONG(self.kind.num_vectors))

    def live_at_first(self, index: ir.Value, tile_x: ir.Value, tile_y: ir.Value) -> ir.Value:
        """Which pixels of a vector lie inside the image, as 0 and 1."""
        b, inside = self.b, []
        for table, center, size in ((self.pixel_x, tile_x, "width"), (self.pixel_y, tile_y, "height")):
            at = b.fadd(self.load(table, index, self.reals), self.lanes.splat(center))
            limit = self.lanes.splat(b.sitofp(self.arguments[size], self.real))
            inside.append(b.fcmp_ordered("<", at, limit))
        return b.zext(b.and_(*inside), self.integers)

    def splat_numbers(self, id_: ir.Value) -> list[ir.Value]:
        base = self.at(self.arguments["splats"], self.times(id_, self.kind.num_floats), self.real)
        return [self.load(base, k, self.real) for k in range(self.kind.num_floats)]

    def row_numbers(self, id_: ir.Value) -> list[ir.Value]:
        base = self.at(self.arguments["rows"], self.times(id_, self.kind.num_rows), INT)
        return [self.load(base, k, INT) for k in range(self.kind.num_rows)]

    def spread(self, numbers: Sequence[ir.Value]) -> list[ir.Value]:
        return [self.lanes.splat(number) for number in numbers]


class _Forward(_Compositing):
    """Channels and transmittance of the tiles."""

    def write(self) -> None:
        kind = self.kind
        light = self.variable(self.reals, kind.num_vectors)
        live = self.variable(self.integers, kind.num_vectors)
        channels = [self.variable(self.reals, kind.num_vectors) for _ in range(kind.num_channels)]

        def tile(tile, tile_x, tile_y):
            with self.all_vectors() as (k, _):
                self.store(self.lanes.constant(1.0, self.real), light, k)
                self.store(self.live_at_first(k, tile_x, tile_y), live, k)
                for channel in channels:
                    self.store(self.lanes.constant(0.0, self.real), channel, k)
            self.all_splats(tile, functools.partial(self.splat, tile_x, tile_y, light, live, channels))
            self.write_tile(tile, [*channels, light])

        self.all_tiles(tile)

    def splat(self, tile_x, tile_y, light, live, channels, id_) -> ir.Value:
        """Adds one splat to a tile; returns whether a pixel is still live."""
        b, lanes, functions = self.b, self.lanes, self.functions
        *numbers, cutoff = self.splat_numbers(id_)
        planes = self.spread(self.scalars.emit(functions.prepare, [*numbers[:9], tile_x, tile_y]))
        splat, row = self.spread(numbers), self.spread(self.row_numbers(id_))
        limit = lanes.splat(b.fadd(cutoff, self.real(CUTOFF_SLACK)))
        any_live = self.variable(self.integers)
        b.store(lanes.constant(0, INT), any_live)
        with self.all_vectors() as (k, _):
            x, y = self.load(self.pixel_x, k, self.reals), self.load(self.pixel_y, k, self.reals)
            rho, *taps = lanes.emit(functions.reach, [*planes, *row, x, y])
            state = self.load(live, k, self.integers)
            is_live = b.icmp_signed("!=", state, lanes.constant(0, INT))
            is_reached = b.and_(is_live, b.fcmp_ordered("<=", rho, limit))
            with b.if_then(lanes.any(is_reached)):
                entries = self.entries(taps)
                values = self.gather(entries, self.is_uniform(entries) if entries else None)
                before = [self.load(light, k, self.reals), is_live, *(self.load(c, k, self.reals) for c in channels)]
                after, still_live, *totals = lanes.emit(
                    functions.forward, [*planes, *splat, *row, *values, x, y, *before]
                )
                self.store(after, light, k)
                self.store(b.zext(still_live, self.integers), live, k)
                for total, channel in zip(totals, channels, strict=True):
                    self.store(total, channel, k)
            now = self.load(live, k, self.integers)
            b.store(b.or_(now, b.load(any_live, typ=self.integers)), any_live)
        return lanes.any(b.icmp_signed("!=", b.load(any_live, typ=self.integers), lanes.constant(0, INT)))

    def write_tile(self, tile: ir.Value, arrays: Sequence[ir.Value]) -> None:
        num_pixels = self.kind.tile_size**2
        base = self.at(self.arguments["image"], self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(array, k, self.real), base, self.b.add(k, LONG(index * num_pixels)))


class _Backward(_Compositing):
    """Cotangents of the splats, of the table, and the absolute gradient."""

    def write(self) -> None:
        kind = self.kind
        light, behind = (self.variable(self.reals, kind.num_vectors) for _ in range(2))
        live = self.variable(self.integers, kind.num_vectors)
        g = [self.variable(self.reals, kind.num_vectors) for _ in range(kind.num_channels)]

        def tile(tile, tile_x, tile_y):
            with self.all_vectors() as (k, _):
                self.store(self.lanes.constant(1.0, self.real), light, k)
                self.store(self.live_at_first(k, tile_x, tile_y), live, k)
            self.read_tile(tile, [behind], self.arguments["behind"])
            self.read_tile(tile, g, self.arguments["g"])
            self.all_splats(tile, functools.partial(self.splat, tile_x, tile_y, light, live, behind, g))

        self.all_tiles(tile)

    def read_tile(self, tile: ir.Value, arrays: Sequence[ir.Value], source: ir.Value) -> None:
        num_pixels = self.kind.tile_size**2
        base = self.at(source, self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            with self.loop(LONG(num_pixels), LONG(self.kind.num_vectors * self.kind.lanes)) as (k, _):
                self.store(self.real(0.0), array, k)
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(base, self.b.add(k, LONG(index * num_pixels)), self.real), array, k)

    def splat(self, tile_x, tile_y, light, live, behind, g, id_) -> ir.Value:
        """Adds the cotangents of one splat in a tile; returns whether a pixel is still live."""
        b, lanes, functions, kind = self.b, self.lanes, self.functions, self.kind
        *numbers, cutoff = self.splat_numbers(id_)
        planes = self.spread(self.scalars.emit(functions.prepare, [*numbers[:9], tile_x, tile_y]))
        splat, row = self.spread(numbers), self.spread(self.row_numbers(id_))
        tile_center = self.spread([tile_x, tile_y])
        jacobian = self.spread([self.load(self.arguments["jacobian"], k, self.real) for k in range(9)])
        limit = lanes.splat(b.fadd(cutoff, self.real(CUTOFF_SLACK)))
        any_live, any_reached = self.variable(self.integers), self.variable(BOOL)
        b.store(lanes.constant(0, INT), any_live)
        b.store(BOOL(0), any_reached)
        num_sums = functions.num_planes + (len(numbers) - 9) + (4 if kind.has_statistic else 0)
        totals = [self.variable(self.reals) for _ in range(num_sums)]
        zero = lanes.constant(0.0, self.real)
        for total in totals:
            b.store(zero, total)
        with self.all_vectors() as (k, _):
            x, y = self.load(self.pixel_x, k, self.reals), self.load(self.pixel_y, k, self.reals)
            rho, *taps = lanes.emit(functions.reach, [*planes, *row, x, y])
            is_live = b.icmp_signed("!=", self.load(live, k, self.integers), lanes.constant(0, INT))
            is_reached = b.and_(is_live, b.fcmp_ordered("<=", rho, limit))
            with b.if_then(lanes.any(is_reached)):
                entries = self.entries(taps)
                is_uniform = self.is_uniform(entries) if entries else None
                values = self.gather(entries, is_uniform)
                before = [self.load(light, k, self.reals), is_live, self.load(behind, k, self.reals)]
                cotangents = [self.load(channel, k, self.reals) for channel in g]
                at_pixel = [*planes, *splat, *row, *values, x, y, *before, *cotangents, *tile_center, *jacobian]
                after, still_live, left, contributes, *rest = lanes.emit(functions.backward, at_pixel)
                self.store(after, light, k)
                self.store(b.zext(still_live, self.integers), live, k)
                self.store(left, behind, k)
                d_values, sums = rest[: len(values)], rest[len(values) :]
                if kind.has_statistic:
                    sums.append(lanes.constant(1.0, self.real))
                with b.if_then(lanes.any(contributes)):
                    b.store(BOOL(1), any_reached)
                    for total, value in zip(totals, sums, strict=True):
                        # Chosen, not multiplied: what a pixel that shows nothing would give may not be finite.
                        value = b.select(contributes, value, zero)
                        b.store(b.fadd(b.load(total, typ=self.reals), value), total)
                    d_values = [b.select(contributes, value, zero) for value in d_values]
                    self.scatter(entries, is_uniform, d_values)
            now = self.load(live, k, self.integers)
            b.store(b.or_(now, b.load(any_live, typ=self.integers)), any_live)
        with b.if_then(b.load(any_reached, typ=BOOL)):
            self.add_totals(id_, numbers, tile_x, tile_y, totals)
        return lanes.any(b.icmp_signed("!=", b.load(any_live, typ=self.integers), lanes.constant(0, INT)))

    def add_totals(self, id_, numbers, tile_x, tile_y, totals) -> None:
        """Sums over lanes, carried from the planes to the homography, added to the splat's rows of the results."""
        kind, functions = self.kind, self.functions
        sums = [self.lanes.sum(self.b.load(total, typ=self.reals)) for total in totals]
        d_planes, others = sums[: functions.num_planes], sums[functions.num_planes :]
        d_M = self.scalars.emit(functions.prepare_vjp, [*numbers[:9], tile_x, tile_y, *d_planes])
        num_others = len(numbers) - 9
        self.add("d_splats", self.times(id_, kind.num_floats), [*d_M, *others[:num_others]])
        if kind.has_statistic:
            self.add("d_tap", self.times(id_, 4), others[num_others:])

    def add(self, name: str, start: ir.Value, values: Sequence[ir.Value]) -> None:
        base = self.at(self.arguments[name], start, self.real)
        for k, value in enumerate(values):
            self.store(self.b.fadd(self.load(base, k, self.real), value), base, k)


_numbers = itertools.count()


@dataclasses.dataclass(frozen=True)
class Loops:
    """Compiled loops; each releases the GIL."""

    forward: Any
    backward: Any


@functools.cache
def loops(kind: Kind) -> Loops:
    """The loops of a kind, compiled at the first call."""
    functions = Functions(kind)
    module = ir.Module("loops")
    tag = next(_numbers)
    forward, backward = f"forward_{tag}", f"backward_{tag}"
    _Forward(kind, functions, module, forward, FORWARD).write()
    _Backward(kind, functions, module, backward, BACKWARD).write()
    addresses = library.compile_module(module)
    return Loops(
        forward=library.as_function(addresses[forward], len(FORWARD), len(INTEGERS)),
        backward=library.as_function(addresses[backward], len(BACKWARD), len(INTEGERS)),
    )
