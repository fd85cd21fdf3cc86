"""Tile lists and compositing by native loops on CPUs: a faster form of `tiles` and `kernels.xla`, on all cores.

Each thread takes a contiguous part of the tiles, with about as many pairs as the others. Results do not depend on
timing; the last bits of gradients depend on the number of threads (`sums`).
"""

import functools
import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import Outline
from a2tg_jax.rasterize.kernels.native import ffi, sums, threads
from a2tg_jax.rasterize.kernels.packing import pack_inputs, split_image, unpack_gradients
from a2tg_jax.rasterize.kernels.traced import refusal_of
from a2tg_jax.rasterize.splats import CompositingSettings, KernelSpec, Splats
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

if TYPE_CHECKING:
    from a2tg_jax.rasterize.kernels.native.lists import ListFunctions
    from a2tg_jax.rasterize.kernels.native.llvm_modules import CompiledFunction

PAIRS_PER_THREAD, SPLATS_PER_THREAD = 2_000, 10_000
"""Least numbers of pairs and of splats that are worth another thread."""


@functools.cache
def refusal(spec: KernelSpec) -> str | None:
    """Return why an appearance cannot run in native loops; None if it can, after compiling them."""
    from a2tg_jax.rasterize.kernels.native.passes import compiled_passes

    return refusal_of(spec, compiled_passes)


def forward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `xla.forward` does."""
    spec = settings.kernel
    name = _registered(spec, "forward", _forward_handler)
    shape = settings.grid.num, spec.num_channels + 1, spec.tile_size**2
    inputs = _packed(spec, settings, splats, texels, regions, cutoff, lists)
    (image,) = ffi.call(name, [(shape, splats.M.dtype)], *inputs)
    return split_image(image)


def _packed(
    spec: KernelSpec, settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, ...]:  # fmt: skip
    """Return `pack_inputs`, with the pixels of the tiles before the last."""
    from a2tg_jax.rasterize.kernels.native.passes import packed_pixels

    *inputs, size = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    return (*inputs, packed_pixels(spec, lists.pixels, splats.M.dtype), size)


def backward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    spec = settings.kernel
    name = _registered(spec, "backward", _backward_handler)
    dtype, shapes = splats.M.dtype, spec.gradient_shapes(splats, texels, probe)
    cotangents = [array.astype(dtype) for array in (g, suffix_sum, jacobian)]
    inputs = (*_packed(spec, settings, splats, texels, regions, cutoff, lists), *cotangents)
    found = ffi.call(name, [(shape, dtype) for shape in shapes], *inputs)
    return unpack_gradients(settings, found, splats, texels, probe)


def tile_lists(
    M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int, height: Array | None = None
) -> TileLists:
    """List the splats of each tile; arguments and result are those of `rasterize.tiles.tile_lists`."""
    from a2tg_jax.rasterize.kernels.native.lists import list_functions

    key = str(M.dtype), grid.tile_size, near_plane
    name = ffi.registered(
        f"lists {key}", ("lists", key), lambda: functools.partial(_list_handler, list_functions(*key))
    )
    results = ((capacity,), jnp.int32), ((grid.num + 1,), jnp.int32), ((), jnp.float32), ((), jnp.bool_)
    size = jnp.asarray([grid.columns, grid.width, grid.height if height is None else height], jnp.int32)
    ids, starts, num_pairs, overflow = ffi.call(name, results, M, cutoff.astype(M.dtype), size)
    return TileLists(ids, starts, num_pairs, overflow, height=height)


def _list_handler(functions: "ListFunctions", arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    """List the splats of each tile, on all threads."""
    M, cutoff, size = arguments
    ids, starts, total, overflow = results
    columns, width, height = map(int, size)
    num = len(cutoff)
    outlines, rectangles = np.empty((num, len(Outline._fields)), M.dtype), np.empty((num, 4), np.int32)

    def bound(first: int, last: int, _: int) -> None:
        functions.bound(*_addresses(M, cutoff, outlines, rectangles), first, last, width, height)

    threads.run_spans(bound, threads.even_spans(num, SPLATS_PER_THREAD))
    room = int(rectangles[:, 3].sum(dtype=np.int64))
    total[...], overflow[...] = room, room > len(ids)
    starts[:], ids[:] = 0, 0
    if overflow:
        return
    order = _depth_order(M[:, 2, 2], np.flatnonzero(rectangles[:, 3]))
    # Each thread lists the pairs of a range of splats, and places them behind those of nearer ranges.
    begins = np.concatenate([[0], np.cumsum(rectangles[order, 3], dtype=np.int64)])
    spans = _parts(begins)
    counts = np.zeros((len(spans), len(starts) - 1), np.int32)
    tiles, splats = np.empty((2, max(1, room)), np.int32)

    def find(first: int, last: int, index: int) -> None:
        found = tiles[begins[first] :], splats[begins[first] :]
        buffers = order[first:], rectangles, outlines, counts[index], *found
        functions.find(*_addresses(*buffers), last - first, columns)

    threads.run_spans(find, spans)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    cursors = starts[:-1] + np.cumsum(counts, axis=0, dtype=np.int32) - counts

    def place(first: int, _: int, index: int) -> None:
        found = tiles[begins[first] :], splats[begins[first] :]
        functions.place(*_addresses(*found, cursors[index], ids), int(counts[index].sum()))

    threads.run_spans(place, spans)


def _depth_order(depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Sort the visible splats by depth, ties by index; int32. float32 depths are sorted by radix, 16 bits at a time."""
    depths = depths[visible]
    if depths.dtype != np.float32:
        return visible[np.argsort(depths, kind="stable")].astype(np.int32)
    # Depths of visible splats are positive, and positive floats are ordered as their bits.
    bits = depths.view(np.uint32)
    order = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable")
    order = order[np.argsort((bits >> 16).astype(np.uint16)[order], kind="stable")]
    return visible[order].astype(np.int32)


def _registered(
    spec: KernelSpec, which: Literal["forward", "backward"], make_handler: Callable[["CompiledFunction"], ffi.Handler]
) -> str:
    """Return the name under which XLA knows a pass of a spec."""
    from a2tg_jax.rasterize.kernels.native.passes import compiled_passes

    def handler() -> ffi.Handler:
        return make_handler(getattr(compiled_passes(spec), which))

    return ffi.registered(f"{which} {spec!r}", (which, spec), handler)


def _addresses(*arrays: np.ndarray) -> list[int]:
    return [array.ctypes.data for array in arrays]


def _forward_handler(run: "CompiledFunction") -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size = arguments
        starts = inputs[1]
        pointers = _addresses(*inputs, results[0])

        def part(first: int, last: int, _: int) -> None:
            run(*pointers, first, last, *map(int, size))

        threads.run_spans(part, _parts(starts))

    return handler


def _backward_handler(run: "CompiledFunction") -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size, g, suffix_sum, jacobian = arguments
        starts = inputs[1]
        parts = _parts(starts)
        room = sums.SumsOfParts(inputs[0], starts, inputs[3], results, parts)
        given = _addresses(*inputs, g, suffix_sum, jacobian)

        def part(first: int, last: int, index: int) -> None:
            run(*given, *_addresses(*room.outputs(index)), first, last, *map(int, size))

        threads.run_spans(part, parts)
        room.add_up()

    return handler


def _parts(starts: np.ndarray) -> list[threads.Span]:
    """Split tiles, or splats, into ranges with about as many pairs each, one per thread that is worth starting.

    Args:
      starts: [items + 1] start of each item's pairs.
    """
    num_items, num_pairs = len(starts) - 1, int(starts[-1])
    count = max(1, min(threads.num_threads(), num_pairs // PAIRS_PER_THREAD))
    work = starts.astype(np.int64) + np.arange(num_items + 1)
    borders = np.searchsorted(work, np.linspace(0, work[-1], count + 1)[1:-1]).tolist()
    borders = [0, *borders, num_items]
    return list(itertools.pairwise(borders))
