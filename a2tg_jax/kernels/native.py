"""Tile lists and compositing by native loops on CPUs: what `tiles` and `compositor` do with XLA, faster, on all cores.

Tiles are dealt to threads in contiguous parts of about as many pairs each. Results do not depend on timing, only, in
the last bits, on the number of threads (`sums`).
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import StaticRule
from a2tg_jax.geometry import Outline
from a2tg_jax.kernels import ffi, sums, threads
from a2tg_jax.kernels.manual_axes import vary_with
from a2tg_jax.kernels.packing import pack_images, pack_splats, unpack_splats
from a2tg_jax.tiles import TileGrid, TileLists

PAIRS_PER_THREAD, SPLATS_PER_THREAD = 2_000, 10_000
"""Fewer than these are not worth another thread."""


def _kind(how, rule, splats, table: Array, images):
    from a2tg_jax.kernels.traced import Kind

    return Kind(
        rule=rule,
        num_rule_numbers=splats.numbers.shape[1],
        num_columns=0 if images is None else table.shape[1],
        dtype=np.dtype(splats.M.dtype).name,
        tile_size=how.grid.tile_size,
        near_plane=how.near_plane,
        has_geometry=how.has_geometry,
        statistic=how.statistic,
    )


def refusal(how, rule, splats) -> str | None:
    """Why there can be no native loops for a rule; None where there are, which are then compiled."""
    return _refusal(_kind(how, StaticRule.of(rule), splats, rule.table, rule.images))


@functools.cache
def _refusal(kind) -> str | None:
    from a2tg_jax.kernels.lanes import Untranslatable
    from a2tg_jax.kernels.loops import loops

    try:
        loops(kind)
    except Untranslatable as error:
        return str(error)
    return None


def forward(how, rule, splats, table: Array, images, cutoff: Array, lists) -> tuple[Array, Array]:
    """As `compositor._forward`: channels [tiles, 1, D, P] and transmittance [tiles, 1, P]."""
    kind = _kind(how, rule, splats, table, images)
    name = _registered(kind, "forward", _forward_handler)
    shape = jax.ShapeDtypeStruct((how.grid.num, kind.num_channels + 1, kind.tile_size**2), splats.M.dtype)
    call = jax.ffi.ffi_call(name, shape, vmap_method="sequential")
    inputs = _inputs(kind, how, splats, table, images, cutoff, lists)
    image = vary_with(inputs, call(*inputs))[:, None]
    return image[:, :, :-1], image[:, :, -1]


def backward(
    how, rule, splats, table: Array, images, cutoff: Array, lists, jacobian, tap: Array, g: Array, behind: Array
):
    """As `compositor._backward`."""
    kind = _kind(how, rule, splats, table, images)
    name = _registered(kind, "backward", _backward_handler)
    dtype, num = splats.M.dtype, splats.M.shape[0]
    shapes = (
        jax.ShapeDtypeStruct((num, kind.num_floats), dtype),
        jax.ShapeDtypeStruct(table.shape, dtype),
        jax.ShapeDtypeStruct(tap.shape if kind.statistic else (1, 4), dtype),
    )
    call = jax.ffi.ffi_call(name, shapes, vmap_method="sequential")
    cotangents = [array.astype(dtype) for array in (g, behind, jacobian)]
    inputs = (*_inputs(kind, how, splats, table, images, cutoff, lists), *cotangents)
    packed, d_table, d_tap = vary_with(inputs, call(*inputs))
    d_splats = unpack_splats(packed, splats, kind.has_geometry)
    d_tap = d_tap.astype(tap.dtype) if kind.statistic else jnp.zeros_like(tap)
    return d_splats, d_table.astype(table.dtype), d_tap


def tile_lists(M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int) -> TileLists:
    """As `tiles.tile_lists`."""
    from a2tg_jax.kernels.lists import list_loops

    key = str(M.dtype), grid.tile_size, near_plane
    name = ffi.registered(f"lists {key}", ("lists", key), lambda: functools.partial(_list_handler, list_loops(*key)))
    shapes = (
        jax.ShapeDtypeStruct((capacity,), jnp.int32),
        jax.ShapeDtypeStruct((grid.num + 1,), jnp.int32),
        jax.ShapeDtypeStruct((), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.bool_),
    )
    size = jnp.asarray([grid.columns, grid.width, grid.height], jnp.int32)
    call = jax.ffi.ffi_call(name, shapes, vmap_method="sequential")
    inputs = M, cutoff.astype(M.dtype), size
    return TileLists(*vary_with(inputs, call(*inputs)))


def _list_handler(loops, arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    M, cutoff, size = arguments
    ids, starts, total, overflow = results
    columns, width, height = map(int, size)
    num = len(cutoff)
    outlines, rectangles = np.empty((num, len(Outline._fields)), M.dtype), np.empty((num, 4), np.int32)
    address = lambda *arrays: [array.ctypes.data for array in arrays]  # noqa: E731

    def bound(first: int, last: int, _: int) -> None:
        loops.bound(*address(M, cutoff, outlines, rectangles), first, last, width, height)

    threads.run_spans(bound, threads.even_spans(num, SPLATS_PER_THREAD))
    room = int(rectangles[:, 3].sum(dtype=np.int64))
    total[...], overflow[...] = room, room > len(ids)
    starts[:], ids[:] = 0, 0
    if overflow:
        return
    order = _depth_order(M[:, 2, 2], np.flatnonzero(rectangles[:, 3]))
    # Every thread lists the pairs of a range of splats, and moves them behind those of the ranges in front of it.
    begins = np.concatenate([[0], np.cumsum(rectangles[order, 3], dtype=np.int64)])
    spans = _parts(begins)
    counts = np.zeros((len(spans), len(starts) - 1), np.int32)
    tiles, splats = np.empty((2, max(1, room)), np.int32)

    def find(first: int, last: int, index: int) -> None:
        found = tiles[begins[first] :], splats[begins[first] :]
        loops.find(*address(order[first:], rectangles, outlines, counts[index], *found), last - first, columns)

    threads.run_spans(find, spans)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    cursors = starts[:-1] + np.cumsum(counts, axis=0, dtype=np.int32) - counts

    def place(first: int, _: int, index: int) -> None:
        found = tiles[begins[first] :], splats[begins[first] :]
        loops.place(*address(*found, cursors[index], ids), int(counts[index].sum()))

    threads.run_spans(place, spans)


def _depth_order(depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """The visible splats by depth, ties by index: int32. float32 depths are sorted by radix, 16 bits at a time."""
    depths = depths[visible]
    if depths.dtype != np.float32:
        return visible[np.argsort(depths, kind="stable")].astype(np.int32)
    # Depths of what is visible are positive, and then ordered as their bits are.
    bits = depths.view(np.uint32)
    order = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable")
    order = order[np.argsort((bits >> 16).astype(np.uint16)[order], kind="stable")]
    return visible[order].astype(np.int32)


def _inputs(kind, how, splats, table: Array, images, cutoff: Array, lists) -> tuple[Array, ...]:
    """ids, starts, splats, images, table, and (columns, width, height)."""
    packed = pack_splats(splats, kind.has_geometry, cutoff).astype(kind.dtype)
    size = jnp.asarray([how.grid.columns, how.grid.width, how.grid.height], jnp.int32)
    return lists.ids, lists.starts, packed, pack_images(images), table.astype(kind.dtype), size


def _registered(kind, which: str, make_handler: Callable[[Any], ffi.Handler]) -> str:
    """The name under which XLA knows the loops of a kind."""
    from a2tg_jax.kernels.loops import loops

    return ffi.registered(f"{which} {kind!r}", (which, kind), lambda: make_handler(getattr(loops(kind), which)))


def _forward_handler(run: Callable) -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size = arguments
        starts = inputs[1]
        pointers = [array.ctypes.data for array in (*inputs, results[0])]

        def part(first: int, last: int, _: int) -> None:
            run(*pointers, first, last, *map(int, size))

        threads.run_spans(part, _parts(starts))

    return handler


def _backward_handler(run: Callable) -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size, g, behind, jacobian = arguments
        starts = inputs[1]
        parts = _parts(starts)
        room = sums.SumsOfParts(inputs[0], starts, inputs[3], results, parts)
        given = [array.ctypes.data for array in (*inputs, g, behind, jacobian)]

        def part(first: int, last: int, index: int) -> None:
            outputs = [array.ctypes.data for array in room.outputs(index)]
            run(*given, *outputs, first, last, *map(int, size))

        threads.run_spans(part, parts)
        room.add_up()

    return handler


def _parts(starts: np.ndarray) -> list[threads.Span]:
    """Ranges of tiles, or of splats, with about as many pairs each, one per thread that is worth starting.

    `starts` [items + 1] is where the pairs of each begin.
    """
    num_items, num_pairs = len(starts) - 1, int(starts[-1])
    count = max(1, min(threads.num_threads(), num_pairs // PAIRS_PER_THREAD))
    work = starts.astype(np.int64) + np.arange(num_items + 1)
    borders = np.searchsorted(work, np.linspace(0, work[-1], count + 1)[1:-1]).tolist()
    borders = [0, *borders, num_items]
    return list(itertools.pairwise(borders))
