"""Native functions that list the splats of each tile: a counting sort, in time proportional to the pairs.

    bound(M, cutoff, outlines, rectangles; first, last, width, height)
    find(order, rectangles, outlines, counts, tiles, splats; num_splats, columns)
    place(tiles, splats, cursors, ids; num_pairs)

`bound` writes the outlines of the splats first..last − 1, and the rectangles of tiles that their boxes cover. `find`
visits the splats in the given order, front to back, and writes every pair whose outline touches its tile; `place` moves
the pairs to their tiles' lists, in the same order.

Buffers: M [N, 9], cutoff [N], outlines [N, 9], rectangles [N, 4] (x0, y0, columns, count); order [splats], counts
[tiles]; tiles and splats [pairs]; ids [capacity]; cursors [tiles], the start of each tile's list before the call and
its end afterwards.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax.numpy as jnp
from llvmlite import ir

from a2tg_jax.core.geometry import Outline, ScreenBounds, clipped_box, unclipped_bounds
from a2tg_jax.rasterize.kernels.native import llvm_modules
from a2tg_jax.rasterize.kernels.native.lanes import INT, Lanes
from a2tg_jax.rasterize.kernels.native.llvm_modules import CompiledFunction
from a2tg_jax.rasterize.kernels.native.tracing import example, trace
from a2tg_jax.rasterize.kernels.native.writer import LONG, Writer
from a2tg_jax.rasterize.tiles import Rectangles, TileGrid, outline_touches, tile_rectangles

BOUND = ("M", "cutoff", "outlines", "rectangles")
FIND = ("order", "rectangles", "outlines", "counts", "tiles", "splats")
PLACE = ("tiles", "splats", "cursors", "ids")
NUM_NUMBERS = len(Outline._fields)


def _example_outline(dtype: str) -> Outline:
    return Outline._make([example(dtype)] * (NUM_NUMBERS - 1) + [example(jnp.bool_)])


class _Bound(Writer):
    def __init__(self, module: ir.Module, name: str, dtype: str, tile_size: int, near_plane: float):
        super().__init__(module, name, BOUND, ("first", "last", "width", "height"), dtype)
        number, integer = example(dtype), example(jnp.int32)
        M = ((number,) * 3,) * 3
        outline = _example_outline(dtype)
        self.bounds, _ = trace(functools.partial(unclipped_bounds, near_plane=near_plane), M, number)
        self.clipped, _ = trace(functools.partial(clipped_box, near_plane=near_plane), M, outline, number)

        def rectangle(bounds: ScreenBounds, width: int, height: int) -> Rectangles:
            return tile_rectangles(bounds, TileGrid(width, height, tile_size))

        bounds = ScreenBounds(number, number, number, number, outline)
        self.rectangle, _ = trace(rectangle, bounds, integer, integer)

    def write(self) -> None:
        b, given, scalars = self.b, self.arguments, Lanes(self.b, 1)
        rooms = [self.variable(self.real) for _ in range(4)]
        with self.loop(self.long(given["first"]), self.long(given["last"])) as (id_, _):
            base = self.at(given["M"], self.times(id_, 9), self.real)
            M = [self.load(base, k, self.real) for k in range(9)]
            cutoff = self.load(given["cutoff"], id_, self.real)
            bounds = scalars.emit(self.bounds, [*M, cutoff])
            box, outline = bounds[:4], bounds[4:]
            for number, room in zip(box, rooms, strict=True):
                b.store(number, room)
            with b.if_then(outline[-1]):
                for number, room in zip(scalars.emit(self.clipped, [*M, *outline, cutoff]), rooms, strict=True):
                    b.store(number, room)
            box = [b.load(room, typ=self.real) for room in rooms]
            rectangle = scalars.emit(self.rectangle, [*box, *outline, given["width"], given["height"]])
            self.store_all(rectangle, self.at(given["rectangles"], self.times(id_, 4), INT))
            outline[-1] = b.uitofp(outline[-1], self.real)
            self.store_all(outline, self.at(given["outlines"], self.times(id_, NUM_NUMBERS), self.real))
        b.ret_void()

    def store_all(self, values: Sequence[ir.Value], base: ir.Value) -> None:
        for k, value in enumerate(values):
            self.store(value, base, k)


class _Find(Writer):
    def __init__(self, module: ir.Module, name: str, dtype: str, tile_size: int):
        super().__init__(module, name, FIND, ("num_splats", "columns"), dtype)
        self.tile_size = tile_size
        touches = functools.partial(outline_touches, tile_size=tile_size)
        self.touches, _ = trace(touches, _example_outline(dtype), example(dtype), example(dtype))

    def write(self) -> None:
        b, given = self.b, self.arguments
        num_found = self.variable(LONG)
        b.store(LONG(0), num_found)
        with self.loop(LONG(0), self.long(given["num_splats"])) as (rank, _):
            id_ = self.load(given["order"], rank, INT)
            rectangle = self.at(given["rectangles"], self.times(self.long(id_), 4), INT)
            x0, y0, columns, count = (self.load(rectangle, k, INT) for k in range(4))
            with b.if_then(b.icmp_signed(">", count, INT(0))):
                outline = self.outline(id_)
                rows = b.sdiv(count, columns)
                with (
                    self.loop(self.long(y0), self.long(b.add(y0, rows))) as (y, _),
                    self.loop(self.long(x0), self.long(b.add(x0, columns))) as (x, _),
                    b.if_then(self.is_touched(outline, x, y)),
                ):
                    tile = b.trunc(b.add(b.mul(y, self.long(given["columns"])), x), INT)
                    found = b.load(num_found, typ=LONG)
                    self.store(tile, given["tiles"], found)
                    self.store(id_, given["splats"], found)
                    b.store(b.add(found, LONG(1)), num_found)
                    number = self.load(given["counts"], self.long(tile), INT)
                    self.store(b.add(number, INT(1)), given["counts"], self.long(tile))
        b.ret_void()

    def outline(self, id_: ir.Value) -> list[ir.Value]:
        base = self.at(self.arguments["outlines"], self.times(self.long(id_), NUM_NUMBERS), self.real)
        *numbers, is_clipped = (self.load(base, k, self.real) for k in range(NUM_NUMBERS))
        return [*numbers, self.b.fcmp_ordered(">", is_clipped, self.real(0.0))]

    def is_touched(self, outline: list[ir.Value], x: ir.Value, y: ir.Value) -> ir.Value:
        size = self.real(self.tile_size)
        corner = [self.b.fmul(self.b.sitofp(index, self.real), size) for index in (x, y)]
        (touches,) = Lanes(self.b, 1).emit(self.touches, [*outline, *corner])
        return touches


class _Place(Writer):
    def __init__(self, module: ir.Module, name: str):
        super().__init__(module, name, PLACE, ("num_pairs",), "float32")

    def write(self) -> None:
        b, given = self.b, self.arguments
        with self.loop(LONG(0), self.long(given["num_pairs"])) as (pair, _):
            tile = self.long(self.load(given["tiles"], pair, INT))
            cursor = self.load(given["cursors"], tile, INT)
            self.store(self.load(given["splats"], pair, INT), given["ids"], self.long(cursor))
            self.store(b.add(cursor, INT(1)), given["cursors"], tile)
        b.ret_void()


@dataclasses.dataclass(frozen=True)
class ListFunctions:
    """Compiled functions `bound`, `find` and `place`."""

    bound: CompiledFunction
    find: CompiledFunction
    place: CompiledFunction


@functools.cache
def list_functions(dtype: str, tile_size: int, near_plane: float) -> ListFunctions:
    """Return the functions for homographies of a dtype and tiles of a size, compiled at the first call."""
    module = ir.Module("lists")
    bound, find, place = (llvm_modules.unique(name) for name in ("bound", "find", "place"))
    _Bound(module, bound, dtype, tile_size, near_plane).write()
    _Find(module, find, dtype, tile_size).write()
    _Place(module, place).write()
    addresses = llvm_modules.compile_module(module)
    return ListFunctions(
        bound=llvm_modules.as_function(addresses[bound], len(BOUND), 4),
        find=llvm_modules.as_function(addresses[find], len(FIND), 2),
        place=llvm_modules.as_function(addresses[place], len(PLACE), 1),
    )
