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

import functools

import jax.numpy as jnp
from jax import Array
from llvmlite import ir

from a2tg_jax.core.geometry import Outline, ScreenBounds, clipped_box, unclipped_bounds
from a2tg_jax.rasterize.kernels.jaxprs import example, trace
from a2tg_jax.rasterize.kernels.native import llvm_code
from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import INT, LONG, CompiledFunction, Writer
from a2tg_jax.rasterize.tiles import Rectangles, TileGrid, outline_touches, tile_edges, tile_rectangles

BOUND = ("M", "cutoff", "outlines", "rectangles")
FIND = ("order", "rectangles", "outlines", "counts", "tiles", "splats")
PLACE = ("tiles", "splats", "cursors", "ids")
NUM_NUMBERS = len(Outline._fields)


def _outline_of(dtype: str) -> Outline:
    """Return an example of an outline for `trace`; its last field is the flag `is_clipped`."""
    return Outline._make([example(dtype)] * (NUM_NUMBERS - 1) + [example(jnp.bool_)])


def _write_bound(module: ir.Module, name: str, dtype: str, tile_size: int, near_plane: float) -> None:
    w = Writer(module, name, BOUND, ("first", "last", "width", "height"), dtype)
    b = w.b
    given = w.arguments
    scalars = Lanes(w.b, 1)
    number = example(dtype)
    integer = example(jnp.int32)
    outline = _outline_of(dtype)
    M = ((number,) * 3,) * 3

    def rectangle(bounds: ScreenBounds, width: int, height: int) -> Rectangles:
        return tile_rectangles(bounds, TileGrid(width, height, tile_size))

    bounds_of, _ = trace(functools.partial(unclipped_bounds, near_plane=near_plane), M, number)
    clipped, _ = trace(functools.partial(clipped_box, near_plane=near_plane), M, outline, number)
    rectangle_of, _ = trace(rectangle, ScreenBounds(number, number, number, number, outline), integer, integer)
    slots = [w.variable(w.real) for _ in range(4)]
    with w.loop(w.long(given["first"]), w.long(given["last"])) as (id_, _):
        base = w.at(given["M"], w.times(id_, 9), w.real)
        numbers = [w.load(base, k, w.real) for k in range(9)]
        cutoff = w.load(given["cutoff"], id_, w.real)
        bounds = scalars.emit(bounds_of, [*numbers, cutoff])
        box = bounds[:4]
        outline_numbers = bounds[4:]
        for edge, slot in zip(box, slots, strict=True):
            b.store(edge, slot)
        # Splats that cross the near plane are few, and their boxes cost more: a branch, not a select.
        with b.if_then(outline_numbers[-1]):
            for edge, slot in zip(scalars.emit(clipped, [*numbers, *outline_numbers, cutoff]), slots, strict=True):
                b.store(edge, slot)
        box = [b.load(slot, typ=w.real) for slot in slots]
        row = w.at(given["rectangles"], w.times(id_, 4), INT)
        size = given["width"], given["height"]
        for k, value in enumerate(scalars.emit(rectangle_of, [*box, *outline_numbers, *size])):
            w.store(value, row, k)
        row = w.at(given["outlines"], w.times(id_, NUM_NUMBERS), w.real)
        # One table of floats: the flag becomes 0 or 1.
        for k, value in enumerate([*outline_numbers[:-1], b.uitofp(outline_numbers[-1], w.real)]):
            w.store(value, row, k)
    b.ret_void()


def _write_find(module: ir.Module, name: str, dtype: str, tile_size: int) -> None:
    w = Writer(module, name, FIND, ("num_splats", "columns"), dtype)
    b = w.b
    given = w.arguments
    number = example(dtype)

    def touches_tile(outline: Outline, x0: Array, y0: Array) -> Array:
        return outline_touches(outline, *tile_edges(x0, y0, tile_size))

    touches, _ = trace(touches_tile, _outline_of(dtype), number, number)
    num_pairs = w.variable(LONG)
    b.store(LONG(0), num_pairs)
    with w.loop(LONG(0), w.long(given["num_splats"])) as (rank, _):
        id_ = w.load(given["order"], rank, INT)
        rectangle = w.at(given["rectangles"], w.times(w.long(id_), 4), INT)
        x0, y0, columns, count = (w.load(rectangle, k, INT) for k in range(4))
        with b.if_then(b.icmp_signed(">", count, INT(0))):
            base = w.at(given["outlines"], w.times(w.long(id_), NUM_NUMBERS), w.real)
            *numbers, is_clipped = (w.load(base, k, w.real) for k in range(NUM_NUMBERS))
            outline = [*numbers, b.fcmp_ordered(">", is_clipped, w.real(0.0))]
            # Only where there are pairs: without columns this would divide by zero.
            rows = b.sdiv(count, columns)
            with (
                w.loop(w.long(y0), w.long(b.add(y0, rows))) as (y, _),
                w.loop(w.long(x0), w.long(b.add(x0, columns))) as (x, _),
            ):
                corner = [b.fmul(b.sitofp(index, w.real), w.real(tile_size)) for index in (x, y)]
                (is_touched,) = Lanes(b, 1).emit(touches, [*outline, *corner])
                with b.if_then(is_touched):
                    tile = b.trunc(b.add(b.mul(y, w.long(given["columns"])), x), INT)
                    pair = b.load(num_pairs, typ=LONG)
                    w.store(tile, given["tiles"], pair)
                    w.store(id_, given["splats"], pair)
                    b.store(b.add(pair, LONG(1)), num_pairs)
                    counted = w.load(given["counts"], w.long(tile), INT)
                    w.store(b.add(counted, INT(1)), given["counts"], w.long(tile))
    b.ret_void()


def _write_place(module: ir.Module, name: str) -> None:
    w = Writer(module, name, PLACE, ("num_pairs",), "float32")
    b = w.b
    given = w.arguments
    with w.loop(LONG(0), w.long(given["num_pairs"])) as (pair, _):
        tile = w.long(w.load(given["tiles"], pair, INT))
        cursor = w.load(given["cursors"], tile, INT)
        w.store(w.load(given["splats"], pair, INT), given["ids"], w.long(cursor))
        w.store(b.add(cursor, INT(1)), given["cursors"], tile)
    b.ret_void()


@functools.cache
def list_functions(dtype: str, tile_size: int, near_plane: float) -> list[CompiledFunction]:
    """Return `bound`, `find` and `place` for a dtype and tiles of a size, compiled at the first call."""
    module = ir.Module("lists")
    bound, find, place = (llvm_code.unique(name) for name in ("bound", "find", "place"))
    _write_bound(module, bound, dtype, tile_size, near_plane)
    _write_find(module, find, dtype, tile_size)
    _write_place(module, place)
    signatures = {bound: (len(BOUND), 4), find: (len(FIND), 2), place: (len(PLACE), 1)}
    return llvm_code.compiled(module, signatures)
