"""Tile lists and compositing by native loops on CPUs: a faster form of `tiles` and `kernels.xla`, on all cores.

Each thread takes a contiguous part of the tiles, with about as many pairs as the others. Results do not depend on
timing; the last bits of gradients depend on the number of threads (`SumsOfParts`).
"""

import functools
import itertools
from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.geometry import Outline
from a2tg_jax.rasterize.kernels.jaxprs import refusal_of
from a2tg_jax.rasterize.kernels.native import ffi
from a2tg_jax.rasterize.kernels.native.lists import list_functions
from a2tg_jax.rasterize.kernels.native.llvm_code import CompiledFunction
from a2tg_jax.rasterize.kernels.native.passes import compiled_pass, packed_outlines, packed_pixels
from a2tg_jax.rasterize.splats import PassInputs, PassSettings, Splats, pack_inputs, unpack_gradients
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

PAIRS_PER_THREAD = 1_000
"""Least number of pairs that is worth another thread."""
SPLATS_PER_THREAD = 10_000
"""Least number of splats that is worth another thread."""
ROWS_PER_THREAD = 2_000
"""Least number of rows of a gradient to add that is worth another thread."""


@functools.cache
def refusal(name: Literal["forward", "backward"], kernel: PassSettings) -> str | None:
    """Return why a pass of an appearance cannot run in native loops; None if it can, after compiling it."""
    return refusal_of(kernel, functools.partial(compiled_pass, name))


def forward(settings: PassSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `xla.forward` does."""
    shape = settings.grid.num, settings.num_channels + 1, settings.num_pixels
    name = _registered(settings.kernel_settings, "forward", _forward_handler)
    packed = _packed(settings, inputs)
    (image,) = ffi.call(name, [(shape, inputs.splats.M.dtype)], *packed)
    return image[:, :-1], image[:, -1]


def backward(
    settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array, g: Array, suffix_sum: Array
) -> tuple[Splats, Array, Array]:
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    dtype = inputs.splats.M.dtype
    cotangents = [array.astype(dtype) for array in (g, suffix_sum, jacobian)]
    shapes = [(shape, dtype) for shape in settings.gradient_shapes(len(inputs.cutoff), inputs.texels.shape)]
    name = _registered(settings.kernel_settings, "backward", _backward_handler)
    gradients = ffi.call(name, shapes, *_packed(settings, inputs), *cotangents)
    return unpack_gradients(settings, gradients, inputs, probe)


def _packed(settings: PassSettings, inputs: PassInputs) -> tuple[Array, ...]:
    """Return `pack_inputs`, with the pixels of the tiles before the last."""
    *packed, size = pack_inputs(settings, inputs)
    outlines = packed_outlines(settings, inputs.splats.M, inputs.cutoff)
    return (*packed, outlines, packed_pixels(settings, inputs.lists.pixels), size)


def _registered(
    kernel: PassSettings, name: Literal["forward", "backward"], make_handler: Callable[[CompiledFunction], ffi.Handler]
) -> str:
    description = f"compositor=native {name} {kernel!r}"
    rank = 3 if name == "forward" else 2
    return ffi.registered(description, (name, kernel), rank, lambda: make_handler(compiled_pass(name, kernel)))


def _forward_handler(run: CompiledFunction) -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size = arguments
        pointers = _addresses(*inputs, results[0])

        def part(first: int, last: int, _: int) -> None:
            run(*pointers, first, last, *map(int, size))

        ffi.run_spans(part, _parts(starts=inputs[1]))

    return handler


def _backward_handler(run: CompiledFunction) -> ffi.Handler:
    def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        *inputs, size, g, suffix_sum, jacobian = arguments
        ids, starts, _, regions, *_ = inputs
        parts = _parts(starts)
        sums = SumsOfParts(ids, starts, regions, results, parts)
        pointers = _addresses(*inputs, g, suffix_sum, jacobian)

        def part(first: int, last: int, index: int) -> None:
            run(*pointers, *_addresses(*sums.outputs(index)), first, last, *map(int, size))

        ffi.run_spans(part, parts)
        sums.add_up()

    return handler


def _addresses(*arrays: np.ndarray) -> list[int]:
    return [array.ctypes.data for array in arrays]


def _parts(starts: np.ndarray) -> list[ffi.Span]:
    """Split tiles, or splats, into ranges with about as many pairs each, one per thread that is worth starting.

    `starts` [items + 1] has the start of each item's pairs.
    """
    num_items = len(starts) - 1
    num_pairs = int(starts[-1])
    count = max(1, min(ffi.threads_of_handler(), num_pairs // PAIRS_PER_THREAD))
    # A tile counts one more than its pairs, so that tiles without pairs are divided as well.
    work = starts.astype(np.int64) + np.arange(num_items + 1)
    borders = np.searchsorted(work, np.linspace(0, work[-1], count + 1)[1:-1]).tolist()
    return list(itertools.pairwise([0, *borders, num_items]))


class SumsOfParts:
    """Results of one call, set to zero at first, and the extra rows of its parts.

    A splat's row of the results belongs to the first part that lists it. The few splats that a later part lists again,
    at the borders between parts, have extra rows of that part, which are added at the end, part by part. The sums equal
    ((part 0 + part 1) + part 2) + …, bit for bit, and no thread needs memory for all splats.

    Args:
      ids: [pairs] splats.
      starts: [tiles + 1] start of each tile's pairs.
      regions: [N, 3] first texel, height and width of each splat's texture; of another length without textures.
      results: cotangents [N, S] of splats, [T, C] of texels, and [N, 4] of the probe, or [1, 4] without a statistic.
      parts: ranges of tiles.
    """

    def __init__(
        self,
        ids: np.ndarray,
        starts: np.ndarray,
        regions: np.ndarray,
        results: list[np.ndarray],
        parts: list[ffi.Span],
    ):
        for result in results:
            result[...] = 0
        d_splats, d_texels, d_probe = self.results = results
        # The extra row of every pair, −1 if it has none; the splat of every extra row; the borders between the parts'.
        self.places = np.full(max(1, starts[parts[-1][1]]), -1, np.int32)
        self.borders = [0]
        splats_of_parts = []
        is_listed = np.zeros(len(d_splats), bool)
        row = np.empty(len(d_splats), np.int32)
        for index, (first, last) in enumerate(parts):
            listed = ids[starts[first] : starts[last]]
            again = np.flatnonzero(is_listed[listed]) if index else np.zeros(0, np.int64)
            splats = np.unique(listed[again])
            row[splats] = self.borders[-1] + np.arange(len(splats), dtype=np.int32)
            # `row` needs no reset: it is read only where this part has just written it.
            self.places[starts[first] + again] = row[listed[again]]
            if index + 1 < len(parts):
                is_listed[listed] = True
            splats_of_parts.append(splats)
            self.borders.append(self.borders[-1] + len(splats))
        self.splats = np.concatenate(splats_of_parts)
        num = max(1, len(self.splats))
        self.more_splats = np.zeros((num, d_splats.shape[1]), d_splats.dtype)
        self.more_probe = np.zeros((num, d_probe.shape[1]), d_probe.dtype)
        has_textures = d_texels.shape[1] > 0 and len(regions) == len(d_splats)
        self.regions = regions[self.splats] if has_textures else np.zeros((0, 3), np.int32)
        # Where textures share texels, two parts may add to the same one: each has its own copy of all.
        self.is_shared = has_textures and len(parts) > 1 and _overlap(regions)
        if self.is_shared:
            self.texels_of_parts = [d_texels, *(np.zeros_like(d_texels) for _ in parts[1:])]
            self.more_texels = self.texels_of_parts
            more_first = self.regions[:, 0]
        else:
            areas = self.regions[:, 1].astype(np.int64) * self.regions[:, 2]
            self.ends = np.concatenate([[0], np.cumsum(areas)])
            self.texels_of_parts = [d_texels] * len(parts)
            self.more_texels = [np.zeros((max(1, self.ends[-1]), d_texels.shape[1]), d_texels.dtype)] * len(parts)
            more_first = self.ends[:-1]
        self.more_first = np.append(more_first, 0).astype(np.int32)

    def outputs(self, index: int) -> list[np.ndarray]:
        """Return the buffers that the backward pass adds to in a part, from `d_splats` on."""
        d_splats, _, d_probe = self.results
        more = self.more_splats, self.more_texels[index], self.more_probe, self.more_first
        return [d_splats, self.texels_of_parts[index], d_probe, self.places, *more]

    def add_up(self) -> None:
        for first, last in itertools.pairwise(self.borders):
            # A splat has at most one extra row in a part, so that threads can divide them.
            spans = ffi.even_spans(last - first, ROWS_PER_THREAD)
            ffi.run_spans(self._add_rows, [(first + begin, first + end) for begin, end in spans])
        for texels in self.texels_of_parts[1:] if self.is_shared else ():
            self.results[1][...] += texels

    def _add_rows(self, first: int, last: int, _: int) -> None:
        d_splats, d_texels, d_probe = self.results
        splats = self.splats[first:last]
        d_splats[splats] += self.more_splats[first:last]
        if len(d_probe) == len(d_splats):
            d_probe[splats] += self.more_probe[first:last]
        if not self.is_shared and len(self.regions):
            begins = self.ends[first:last]
            ends = self.ends[first + 1 : last + 1]
            # Extra texels are one after the other, row by row: each is moved from its row's begin to its texture's.
            entries = np.arange(self.ends[first], self.ends[last])
            more = self.more_texels[0][self.ends[first] : self.ends[last]]
            d_texels[entries + np.repeat(self.regions[first:last, 0] - begins, ends - begins)] += more


def _overlap(regions: np.ndarray) -> bool:
    first = regions[:, 0].astype(np.int64)
    area = regions[:, 1].astype(np.int64) * regions[:, 2]
    # Sorted by first texel; the area comes along in the lower bits.
    both = np.sort(first << 32 | area)
    first = both >> 32
    area = both & 0xFFFFFFFF
    return bool(np.any(first[:-1] + area[:-1] > first[1:]))


def tile_lists(M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int) -> TileLists:
    """List the splats of each tile, with the arguments and result of `rasterize.tiles.tile_lists`."""
    key = str(M.dtype), grid.tile_size, near_plane
    name = ffi.registered(
        f"compositor=native lists {key}",
        ("lists", key),
        1,
        lambda: functools.partial(_list_handler, list_functions(*key)),
    )
    results = ((capacity,), jnp.int32), ((grid.num + 1,), jnp.int32), ((), jnp.float32), ((), jnp.bool_)
    size = jnp.asarray([grid.columns, grid.width, grid.height], jnp.int32)
    ids, starts, num_pairs, overflow = ffi.call(name, results, M, cutoff.astype(M.dtype), size)
    return TileLists(ids, starts, num_pairs, overflow)


def _list_handler(functions: list[CompiledFunction], arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    run_bound, run_find, run_place = functions
    M, cutoff, size = arguments
    ids, starts, total, overflow = results
    columns, width, height = map(int, size)
    num = len(cutoff)
    outlines = np.empty((num, len(Outline._fields)), M.dtype)
    rectangles = np.empty((num, 4), np.int32)

    def bound(first: int, last: int, _: int) -> None:
        run_bound(*_addresses(M, cutoff, outlines, rectangles), first, last, width, height)

    ffi.run_spans(bound, ffi.even_spans(num, SPLATS_PER_THREAD))
    room = int(rectangles[:, 3].sum(dtype=np.int64))
    total[...] = room
    overflow[...] = room > len(ids)
    # XLA's buffers are not initialised, and places behind the last pair are not written.
    starts[:] = 0
    ids[:] = 0
    if overflow:
        return
    visible = np.flatnonzero(rectangles[:, 3])
    order = visible[_depth_order(M[visible, 2, 2])].astype(np.int32)
    # A counting sort. Each thread lists the pairs of a range of splats, and places them behind pairs of nearer splats.
    begins = np.concatenate([[0], np.cumsum(rectangles[order, 3], dtype=np.int64)])
    spans = _parts(begins)
    counts = np.zeros((len(spans), len(starts) - 1), np.int32)
    tiles, splats = np.empty((2, max(1, room)), np.int32)

    def find(first: int, last: int, index: int) -> None:
        pairs = tiles[begins[first] :], splats[begins[first] :]
        buffers = order[first:], rectangles, outlines, counts[index], *pairs
        run_find(*_addresses(*buffers), last - first, columns)

    ffi.run_spans(find, spans)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    # Where each thread begins in each tile's list: behind the pairs that threads of nearer splats found there.
    cursors = starts[:-1] + np.cumsum(counts, axis=0, dtype=np.int32) - counts

    def place(first: int, _: int, index: int) -> None:
        pairs = tiles[begins[first] :], splats[begins[first] :]
        run_place(*_addresses(*pairs, cursors[index], ids), int(counts[index].sum()))

    ffi.run_spans(place, spans)


def _depth_order(depths: np.ndarray) -> np.ndarray:
    """Return the order of the depths of visible splats, ties by index."""
    if depths.dtype != np.float32:
        return np.argsort(depths, kind="stable")
    # Depths of visible splats are positive, and positive floats are ordered as their bits. These are sorted 16 at a
    # time, from the lowest: numpy's stable sort of 16-bit integers is a radix sort.
    bits = depths.view(np.uint32)
    order = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable")
    return order[np.argsort((bits >> 16).astype(np.uint16)[order], kind="stable")]
