"""Tile lists and compositing by native loops on CPUs: what `tiles` and `compositor` do with XLA, faster, on all cores.

Tiles are dealt to threads in contiguous parts of about as many pairs each. Results do not depend on timing, only, in
the last bits, on the number of threads (`sums`).
"""

import functools
import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import AppearanceRule, StaticRule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import Outline
from a2tg_jax.rasterize.kernels.manual_axes import vary_with
from a2tg_jax.rasterize.kernels.native import ffi, sums, threads
from a2tg_jax.rasterize.kernels.packing import pack_regions, pack_splats, unpack_splats
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

if TYPE_CHECKING:
    from a2tg_jax.rasterize.kernels.native.lists import ListLoops
    from a2tg_jax.rasterize.kernels.native.traced import KernelSpec

PAIRS_PER_THREAD, SPLATS_PER_THREAD = 2_000, 10_000
"""Fewer than these are not worth another thread."""


def _spec(
    settings: CompositingSettings, rule: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None
) -> "KernelSpec":
    """What the loops for these inputs are compiled for."""
    from a2tg_jax.rasterize.kernels.native.traced import KernelSpec

    return KernelSpec(
        rule=rule,
        num_rule_numbers=splats.numbers.shape[1],
        num_columns=0 if regions is None else texels.shape[1],
        dtype=np.dtype(splats.M.dtype).name,
        tile_size=settings.grid.tile_size,
        near_plane=settings.near_plane,
        has_geometry=settings.has_geometry,
        statistic=settings.statistic,
        num_colors=settings.num_colors,
    )


def refusal(settings: CompositingSettings, rule: AppearanceRule, splats: Splats) -> str | None:
    """Why there can be no native loops for a rule; None where there are, which are then compiled."""
    return _refusal(_spec(settings, StaticRule.of(rule), splats, rule.texels, rule.regions))


@functools.cache
def _refusal(spec: "KernelSpec") -> str | None:
    from a2tg_jax.rasterize.kernels.native.lanes import Untranslatable
    from a2tg_jax.rasterize.kernels.native.loops import loops
    from a2tg_jax.rasterize.kernels.native.traced import place_of

    try:
        loops(spec)
    except Untranslatable as error:
        return str(error) + (place_of(error.primitive, spec) if error.primitive else "")
    return None


def forward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """As `xla.forward`: channels [tiles, 1, D, P] and transmittance [tiles, 1, P]."""
    spec = _spec(settings, static, splats, texels, regions)
    name = _registered(spec, "forward", _forward_handler)
    shape = jax.ShapeDtypeStruct((settings.grid.num, spec.num_channels + 1, spec.tile_size**2), splats.M.dtype)
    call = jax.ffi.ffi_call(name, shape, vmap_method="sequential")
    inputs = _inputs(spec, settings, splats, texels, regions, cutoff, lists)
    image = vary_with(inputs, call(*inputs))[:, None]
    return image[:, :, :-1], image[:, :, -1]


def backward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """As `xla.backward`."""
    spec = _spec(settings, static, splats, texels, regions)
    name = _registered(spec, "backward", _backward_handler)
    dtype, num = splats.M.dtype, splats.M.shape[0]
    shapes = (
        jax.ShapeDtypeStruct((num, spec.num_floats), dtype),
        jax.ShapeDtypeStruct(texels.shape, dtype),
        jax.ShapeDtypeStruct(probe.shape if spec.statistic else (1, 4), dtype),
    )
    call = jax.ffi.ffi_call(name, shapes, vmap_method="sequential")
    cotangents = [array.astype(dtype) for array in (g, suffix_sum, jacobian)]
    inputs = (*_inputs(spec, settings, splats, texels, regions, cutoff, lists), *cotangents)
    packed, d_texels, d_probe = vary_with(inputs, call(*inputs))
    d_splats = unpack_splats(packed, splats, spec.has_geometry)
    d_probe = d_probe.astype(probe.dtype) if spec.statistic else jnp.zeros_like(probe)
    return d_splats, d_texels.astype(texels.dtype), d_probe


def tile_lists(M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int) -> TileLists:
    """List the splats of each tile; arguments and result are those of `rasterize.tiles.tile_lists`."""
    from a2tg_jax.rasterize.kernels.native.lists import list_loops

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


def _list_handler(loops: "ListLoops", arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
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


def _inputs(
    spec: "KernelSpec", settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, ...]:  # fmt: skip
    """ids, starts, splats, regions, texels, and (columns, width, height)."""
    packed = pack_splats(splats, spec.has_geometry, cutoff).astype(spec.dtype)
    size = jnp.asarray([settings.grid.columns, settings.grid.width, settings.grid.height], jnp.int32)
    return lists.ids, lists.starts, packed, pack_regions(regions), texels.astype(spec.dtype), size


def _registered(spec: "KernelSpec", which: str, make_handler: Callable[[Any], ffi.Handler]) -> str:
    """The name under which XLA knows the loops that a spec describes."""
    from a2tg_jax.rasterize.kernels.native.loops import loops

    return ffi.registered(f"{which} {spec!r}", (which, spec), lambda: make_handler(getattr(loops(spec), which)))


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
        *inputs, size, g, suffix_sum, jacobian = arguments
        starts = inputs[1]
        parts = _parts(starts)
        room = sums.SumsOfParts(inputs[0], starts, inputs[3], results, parts)
        given = [array.ctypes.data for array in (*inputs, g, suffix_sum, jacobian)]

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
