"""Forward and backward pass over tiles, splats and pixels, around the functions of `pixel`.

One call composites the tiles first..last − 1. A block is R pixels of a tile, one register of the processor. Blocks that
a splat's outline does not touch, or whose pixels have all stopped, are skipped: words of 64 bits say so. Every other
splat of a tile's list is prepared once (scalar code), then applied to its blocks, a few at once (vector code, L lanes).

    forward(ids, starts, splats, regions, texels, outlines, pixels, result; first, last, columns, width, height)
    backward(ids, starts, splats, regions, texels, outlines, pixels, g, suffix_sum, jacobian, d_splats, d_texels,
             d_probe, places, more_splats, more_texels, more_probe, more_first; the same)

Buffers: ids [pairs], starts [tiles + 1], splats [N, S] packed (`num_floats`), regions [N, 3], texels [T, C], outlines
(`packed_outlines`), pixels (`packed_pixels`) of cameras with rays, result [tiles, D + 1, P] channels and transmittance,
g [tiles, D, P], suffix_sum [tiles, P], jacobian [3, 3]; the pass adds to d_splats [N, S], d_texels [T, C] and d_probe
[N, 4]. `places` [pairs] holds −1, or k if the splat's own row belongs to another thread: the pair then adds to row k of
more_splats and more_probe, and to more_texels from texel more_first[k] on.
"""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from llvmlite import ir

from a2tg_jax.core.geometry import Outline, unclipped_bounds
from a2tg_jax.rasterize.kernels.jaxprs import CUTOFF_SLACK, PixelFunctions
from a2tg_jax.rasterize.kernels.native import llvm_code
from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import BOOL, INT, LONG, POINTER, CompiledFunction
from a2tg_jax.rasterize.kernels.native.texture_lookups import NativeTexture, Place, TexelWriter
from a2tg_jax.rasterize.splats import PassSettings
from a2tg_jax.rasterize.tile_pixels import TilePixels

INTEGERS = ("first", "last", "columns", "width", "height")
FORWARD = ("ids", "starts", "splats", "regions", "texels", "outlines", "pixels", "result")
BACKWARD = (
    *(*FORWARD[:-1], "g", "suffix_sum", "jacobian", "d_splats", "d_texels", "d_probe"),
    *("places", "more_splats", "more_texels", "more_probe", "more_first"),
)
WORD = 64
"""Number of blocks of which a word says something, a bit each."""
SPLATS_AT_ONCE = 64
"""Number of splats whose blocks are found before they are composited. They do not wait for each other's memory."""
NUM_OUTLINE = len(Outline._fields)


def blocks_at_once(settings: PassSettings) -> int:
    """Return the number of blocks that are composited at once: some compute while results of others are awaited.

    More of them need more registers and longer compiling (experiments/NOTEBOOK.md, "Speed on CPUs").
    """
    if settings.dtype != "float32":
        return 1  # exp is called lane by lane, also for lanes that are not reached.
    return 2 if settings.num_values else 4


def pixel_order(tile_size: int, lanes: int) -> np.ndarray:
    """Return the pixels of a tile, counted row by row, in the order of its blocks of some lanes.

    If rectangles of as many pixels fill the tile, blocks are compact: they see fewer splats and texels than rows do.
    """
    # 2ᵏ lanes: 2^⌊k/2⌋ rows, as 2×4 for 8 lanes.
    height = 1 << (lanes.bit_length() - 1) // 2
    width = lanes // height
    pixels = np.arange(tile_size**2).reshape(tile_size, tile_size)
    if tile_size % height or tile_size % width:
        return pixels.reshape(-1)
    blocks = pixels.reshape(tile_size // height, height, tile_size // width, width)
    return np.moveaxis(blocks, 2, 1).reshape(-1)


def packed_outlines(settings: PassSettings, M: Array, cutoff: Array) -> Array:
    """Pack the outline of each splat as a row; its flag becomes 0 or 1. With rays, which have frames, it is empty."""
    if settings.has_rays:
        return jnp.zeros((1, 0), settings.dtype)
    rows = tuple(tuple(M[:, i, k] for k in range(3)) for i in range(3))
    outline = unclipped_bounds(rows, cutoff, settings.near_plane).outline
    columns = [column.astype(settings.dtype) for column in outline]
    # XLA would compute all of it again for each column of a stack.
    return jnp.stack(jax.lax.optimization_barrier(columns), axis=1)


def packed_pixels(settings: PassSettings, pixels: TilePixels | None) -> Array:
    """Pack the pixels of each tile as a row: its numbers, then x, y and whether they are seen, in the order of blocks.

    All four parts fill whole blocks. Without rays, the result is empty.
    """
    if pixels is None:
        return jnp.zeros((1, 0), settings.dtype)
    lanes = llvm_code.num_lanes(settings.dtype)
    order = pixel_order(settings.grid.tile_size, lanes)
    numbers = jnp.concatenate([pixels.centers, pixels.frames.reshape(-1, 4)], axis=1)
    x = pixels.offsets[:, 0, order]
    y = pixels.offsets[:, 1, order]
    parts = numbers, x, y, pixels.is_seen[:, order].astype(settings.dtype)
    return jnp.concatenate([jnp.pad(part, ((0, 0), (0, -part.shape[1] % lanes))) for part in parts], axis=1)


class _ListedSplat(NamedTuple):
    id: ir.Value  # its index
    position: ir.Value  # its position in `ids`
    numbers: list[ir.Value]  # numbers as in memory, without the cutoff
    cutoff: ir.Value  # squared distance beyond which it is invisible


class _PreparedSplat(NamedTuple):
    planes: list[ir.Value]  # `rasterize.pixel.Planes`, the same in every lane
    spread: list[ir.Value]  # its numbers in every lane
    texture: NativeTexture | None  # its texture, if the appearance has textures
    spread_region: list[ir.Value]  # `TextureRegion` in every lane
    limit: ir.Value  # squared distance within which its texture is read, in every lane


class _Vector(NamedTuple):
    blocks: list[ir.Value]  # numbers of its blocks in the tile
    x: ir.Value  # horizontal coordinates from the tile's centre
    y: ir.Value  # vertical coordinates
    place: Place | None  # positions in the splat's texture, if it has one
    is_live: ir.Value  # pixels that have not stopped


class _Pass(TexelWriter):
    """Base of both passes. Generators write a loop, or a branch, which the body of the caller's `for` fills."""

    rows_of_splats: ClassVar[tuple[str, ...]] = ("splats",)

    def __init__(self, functions: PixelFunctions, module: ir.Module, name: str, buffers: Sequence[str]):
        settings = functions.settings
        super().__init__(module, name, buffers, INTEGERS, settings.dtype)
        self.settings = settings
        self.functions = functions
        self.num_values = settings.num_values
        self.empty = settings.static.functions.empty
        self.tile_size = settings.grid.tile_size
        width = llvm_code.num_lanes(settings.dtype)
        self.block = Lanes(self.b, width)
        self.lanes = Lanes(self.b, blocks_at_once(settings) * width)
        self.scalars = Lanes(self.b, 1)
        self.num_blocks = -(-settings.num_pixels // width)
        self.reals = self.lanes.vector(self.real)
        self.block_reals = self.block.vector(self.real)
        self.block_integers = self.block.vector(INT)
        order = pixel_order(self.tile_size, width)
        y, x = np.stack(np.divmod(order, self.tile_size)) - (self.tile_size - 1) / 2
        # Lanes past the last pixel are outside every image. The block past the last one, never live, fills up vectors.
        past = np.full((self.num_blocks + 1) * width - len(order), 1e9)
        self.transmittance = self.variable(self.block_reals, self.num_blocks + 1)
        self.live = self.variable(self.block_integers, self.num_blocks + 1)
        # Bit k of word w marks block w·WORD + k. R blocks are found at once.
        self.num_words = -(-self.num_blocks // WORD)
        self.finds_per_word = min(WORD // width, -(-self.num_blocks // width))
        self.live_words = self.variable(LONG, self.num_words)
        self.words = self.variable(LONG, self.num_words)
        self.touched = self.variable(LONG, self.num_words * SPLATS_AT_ONCE)
        self.pixel_x = self._constants(f"{name}.x", self.real, [*x, *past])
        self.pixel_y = self._constants(f"{name}.y", self.real, [*y, *past])
        self.boxes = [self._constants(f"{name}.{edge}", self.real, table) for edge, table in self._boxes(x, y).items()]
        # Pixels in memory are row by row.
        self.order = self._constants(f"{name}.order", INT, order)

    def _boxes(self, x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return the edges of the boxes around the pixels of each block; there are boxes of all bits of the words."""
        width = self.block.width
        num_bits = self.num_words * self.finds_per_word * width
        edges = {}
        for low, high, places in (("left", "right", x), ("top", "bottom", y)):
            # Repeated pixels do not change a box.
            blocks = np.pad(places, (0, -len(places) % width), mode="edge").reshape(-1, width)
            edges[low] = np.pad(blocks.min(axis=1), (0, num_bits - self.num_blocks))
            edges[high] = np.pad(blocks.max(axis=1), (0, num_bits - self.num_blocks))
        return edges

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
        width = self.block.width
        num = self.functions.num_tile_numbers
        # Each part fills whole vectors, as `packed_pixels` has padded it.
        header = -(-num // width) * width
        part = self.num_blocks * width
        base = self.at(self.arguments["pixels"], self.times(tile, header + 3 * part), self.real)
        # Of the block past the last one, x and y are what comes behind them in the row; they do not matter.
        parts = (self.at(base, LONG(header + k * part), self.real) for k in range(3))
        self.pixel_x, self.pixel_y, self.is_seen = parts
        return [self.load(base, LONG(k), self.real) for k in range(num)]

    def splats(self, tile: ir.Value, tile_numbers: list[ir.Value]) -> Iterator[_ListedSplat]:
        """Write a loop over a tile's list, until no pixel is live; yield the splats that touch live blocks, which
        `words` then holds."""
        b = self.b
        starts = self.arguments["starts"]
        first = self.long(self.load(starts, b.add(tile, LONG(0)), INT))
        last = self.long(self.load(starts, b.add(tile, LONG(1)), INT))
        num_parts = b.sdiv(b.add(b.sub(last, first), LONG(SPLATS_AT_ONCE - 1)), LONG(SPLATS_AT_ONCE))
        with self.loop(LONG(0), num_parts) as (part, done):
            begin = b.add(first, self.times(part, SPLATS_AT_ONCE))
            end = b.add(begin, LONG(SPLATS_AT_ONCE))
            end = b.select(b.icmp_signed("<", end, last), end, last)
            with self.loop(begin, end) as (position, _):
                id_ = self.long(self.load(self.arguments["ids"], position, INT))
                self.find_touched(id_, self.touched_words(b.sub(position, begin)), tile_numbers)
            with self.loop(begin, end) as (position, _):
                touched = self.touched_words(b.sub(position, begin))
                for w in range(self.num_words):
                    live = self.load(self.live_words, w, LONG)
                    self.store(b.and_(self.load(touched, w, LONG), live), self.words, w)
                with b.if_then(self.any_word(self.words)):
                    yield self.listed(position)
            going_on = b.append_basic_block("on")
            b.cbranch(self.any_word(self.live_words), going_on, done)
            b.position_at_end(going_on)

    def listed(self, position: ir.Value) -> _ListedSplat:
        """Load a splat of the list."""
        num_floats = self.settings.num_floats
        id_ = self.long(self.load(self.arguments["ids"], position, INT))
        row = self.at(self.arguments["splats"], self.times(id_, num_floats), self.real)
        *numbers, cutoff = (self.load(row, k, self.real) for k in range(num_floats))
        return _ListedSplat(id_, position, numbers, cutoff)

    def touched_words(self, index: ir.Value) -> ir.Value:
        return self.at(self.touched, self.times(index, self.num_words), LONG)

    def find_touched(self, id_: ir.Value, words: ir.Value, tile: list[ir.Value]) -> None:
        """Write which blocks a splat's outline touches, and fetch what compositing will read and write."""
        b = self.b
        block = self.block
        offset = self.times(id_, self.settings.num_floats)
        for name in self.rows_of_splats:
            self.prefetch(self.at(self.arguments[name], offset, self.real))
        if self.settings.has_rays:
            # The outline is not in the frame of the tile. The list has tested it against the tile.
            for w in range(self.num_words):
                self.store(LONG(-1), words, w)
            return
        row = self.at(self.arguments["outlines"], self.times(id_, NUM_OUTLINE), self.real)
        *numbers, is_clipped = (block.broadcast(self.load(row, k, self.real)) for k in range(NUM_OUTLINE))
        outline = [*numbers, b.fcmp_ordered(">", is_clipped, block.constant(0.0, self.real))]
        centers = [block.broadcast(tile[axis]) for axis in (0, 0, 1, 1)]
        word = self.variable(LONG)
        with self.loop(LONG(0), LONG(self.num_words)) as (w, _):
            b.store(LONG(0), word)
            with self.loop(LONG(0), LONG(self.finds_per_word)) as (index, _):
                at = b.add(self.times(w, self.finds_per_word), index)
                tables = zip(self.boxes, centers, strict=True)
                edges = [b.fadd(self.load(table, at, self.block_reals), center) for table, center in tables]
                (touches,) = block.emit(self.functions.touches, [*outline, *edges])
                bits = b.zext(b.bitcast(touches, ir.IntType(block.width)), LONG)
                shifted = b.shl(bits, self.times(index, block.width))
                b.store(b.or_(b.load(word, typ=LONG), shifted), word)
            self.store(b.load(word, typ=LONG), words, w)

    def prefetch(self, address: ir.Value) -> None:
        b = self.b
        function_type = ir.FunctionType(ir.VoidType(), [POINTER, INT, INT, INT])
        name = "llvm.prefetch.p0"
        function = b.module.globals.get(name) or ir.Function(b.module, function_type, name)
        b.call(function, [address, INT(0), INT(3), INT(1)])

    def any_word(self, words: ir.Value) -> ir.Value:
        """Return whether a bit of some words is set."""
        b = self.b
        union = self.load(words, 0, LONG)
        for w in range(1, self.num_words):
            union = b.or_(union, self.load(words, w, LONG))
        return b.icmp_unsigned("!=", union, LONG(0))

    def all_blocks(self) -> contextlib.AbstractContextManager[tuple[ir.Value, ir.Block]]:
        return self.loop(LONG(0), LONG(self.num_blocks))

    def pixel(self, k: ir.Value, channel: int) -> ir.Value:
        """Return the index of a tile's lane k among its numbers [channels, P]."""
        return self.b.add(self.long(self.load(self.order, k, INT)), LONG(channel * self.settings.num_pixels))

    def begin_tile(self, tile: list[ir.Value]) -> None:
        """Set the transmittance to 1, and the pixels live that are inside the image and have a ray."""
        b = self.b
        lanes = self.block
        self.store(lanes.constant(0, INT), self.live, self.num_blocks)
        self.store(lanes.constant(1.0, self.real), self.transmittance, self.num_blocks)
        for w in range(self.num_words):
            self.store(LONG(0), self.live_words, w)
        with self.all_blocks() as (k, _):
            self.store(lanes.constant(1.0, self.real), self.transmittance, k)
            if self.settings.has_rays:
                is_seen = self.load(self.is_seen, k, self.block_reals)
                is_live = b.fcmp_ordered(">", is_seen, lanes.constant(0.5, self.real))
            else:
                inside = []
                for table, center, size in zip((self.pixel_x, self.pixel_y), tile, ("width", "height"), strict=True):
                    at = b.fadd(self.load(table, k, self.block_reals), lanes.broadcast(center))
                    limit = lanes.broadcast(b.sitofp(self.arguments[size], self.real))
                    inside.append(b.fcmp_ordered("<", at, limit))
                is_live = b.and_(*inside)
            self.set_live(k, is_live)

    def set_live(self, k: ir.Value, is_live: ir.Value) -> None:
        """Store the live pixels of a block, and whether there are any."""
        b = self.b
        self.store(b.zext(is_live, self.block_integers), self.live, k)
        w = b.udiv(k, LONG(WORD))
        shift = b.urem(k, LONG(WORD))
        others = b.and_(self.load(self.live_words, w, LONG), b.not_(b.shl(LONG(1), shift)))
        self.store(b.or_(others, b.shl(b.zext(self.block.any(is_live), LONG), shift)), self.live_words, w)

    def prepare(self, splat: _ListedSplat, tile: list[ir.Value]) -> _PreparedSplat:
        """Prepare a splat of the list for a tile."""
        arguments = self.arguments
        planes = self.scalars.emit(self.functions.prepare, [*splat.numbers[:9], *tile])
        limit = self.b.fadd(splat.cutoff, self.real(CUTOFF_SLACK))
        region_row = self.at(arguments["regions"], self.times(splat.id, 3), INT)
        region = [self.load(region_row, k, INT) for k in range(3)] if self.num_values else []
        texture = self.texture(arguments["texels"], *map(self.long, region)) if region else None
        spread = self.spread(planes), self.spread(splat.numbers)
        return _PreparedSplat(*spread, texture, self.spread(region), self.lanes.broadcast(limit))

    def touched_vectors(self, splat: _PreparedSplat) -> Iterator[_Vector]:
        """Write a loop over the blocks in `words`, some at once."""
        b = self.b
        lanes = self.lanes
        left = self.variable(LONG)
        with self.loop(LONG(0), LONG(self.num_words)) as (w, _):
            b.store(self.load(self.words, w, LONG), left)
            test = b.append_basic_block("test")
            body = b.append_basic_block("body")
            after = b.append_basic_block("after")
            b.branch(test)
            b.position_at_end(test)
            b.cbranch(b.icmp_unsigned("!=", b.load(left, typ=LONG), LONG(0)), body, after)
            b.position_at_end(body)
            blocks = [self.take(left, w) for _ in range(lanes.width // self.block.width)]
            x = self.gather(self.pixel_x, blocks, self.block_reals)
            y = self.gather(self.pixel_y, blocks, self.block_reals)
            is_live = b.icmp_signed("!=", self.gather(self.live, blocks, self.block_integers), lanes.constant(0, INT))
            place = None
            if splat.texture:
                rho, *position = lanes.emit(self.functions.reach, [*splat.planes, *splat.spread_region, x, y])
                is_reached = b.and_(is_live, b.fcmp_ordered("<=", rho, splat.limit))
                place = Place(position[0], position[1], is_reached)
            yield _Vector(blocks, x, y, place, is_live)
            b.branch(test)
            b.position_at_end(after)

    def take(self, left: ir.Value, w: ir.Value) -> ir.Value:
        """Take a block from the bits of word w that are left; return its number, the one past the last if none is."""
        b = self.b
        bits = b.load(left, typ=LONG)
        index = self.scalars.call("cttz.i64", LONG, [bits, BOOL(0)])
        b.store(b.and_(bits, b.sub(bits, LONG(1))), left)
        k = b.add(self.times(w, WORD), index)
        return b.select(b.icmp_unsigned("!=", bits, LONG(0)), k, LONG(self.num_blocks))

    def gather(self, base: ir.Value, blocks: Sequence[ir.Value], type_: ir.Type) -> ir.Value:
        """Load the lanes of some blocks as one vector."""
        b = self.b
        parts = [self.load(base, k, type_) for k in blocks]
        while len(parts) > 1:
            mask = ir.Constant(ir.VectorType(INT, 2 * parts[0].type.count), [*range(2 * parts[0].type.count)])
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [b.shuffle_vector(first, second, mask) for first, second in pairs]
        return parts[0]

    def parts(self, vector: ir.Value) -> list[ir.Value]:
        """Return the lanes of a vector by block; the inverse of `gather`."""
        width = self.block.width
        masks = [[*range(first, first + width)] for first in range(0, vector.type.count, width)]
        lanes = ir.VectorType(INT, width)
        return [self.b.shuffle_vector(vector, vector, ir.Constant(lanes, mask)) for mask in masks]

    def scatter(self, vector: ir.Value, base: ir.Value, blocks: Sequence[ir.Value]) -> None:
        """Store the lanes of some blocks, from one vector."""
        for k, part in zip(blocks, self.parts(vector), strict=True):
            self.store(part, base, k)

    def spread(self, numbers: Sequence[ir.Value]) -> list[ir.Value]:
        return [self.lanes.broadcast(number) for number in numbers]

    def store_state(self, vector: _Vector, transmittance: ir.Value, is_live: ir.Value) -> None:
        b = self.b
        self.scatter(transmittance, self.transmittance, vector.blocks)
        with b.if_then(self.lanes.any(b.xor(is_live, vector.is_live))):
            # Without the block past the last one, which has no bit: its pixels do not stop.
            for k, part in zip(vector.blocks, self.parts(is_live), strict=True):
                with b.if_then(b.icmp_signed("!=", k, LONG(self.num_blocks))):
                    self.set_live(k, part)


class _Forward(_Pass):
    """Pass that computes channels and transmittance of the tiles."""

    def write(self) -> None:
        channels = [self.variable(self.block_reals, self.num_blocks + 1) for _ in range(self.settings.num_channels)]
        for tile, tile_numbers in self.tiles():
            self.begin_tile(tile_numbers)
            with self.loop(LONG(0), LONG(self.num_blocks + 1)) as (k, _):
                for channel in channels:
                    self.store(self.block.constant(0.0, self.real), channel, k)
            for listed in self.splats(tile, tile_numbers):
                splat = self.prepare(listed, tile_numbers)
                for vector in self.touched_vectors(splat):
                    self.composite(splat, vector, channels)
            arrays = [*channels, self.transmittance]
            num_pixels = self.settings.num_pixels
            base = self.at(self.arguments["result"], self.times(tile, num_pixels * len(arrays)), self.real)
            for index, array in enumerate(arrays):
                with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                    self.store(self.load(array, k, self.real), base, self.pixel(k, index))

    def composite(self, splat: _PreparedSplat, vector: _Vector, channels: Sequence[ir.Value]) -> None:
        blocks = vector.blocks
        place = vector.place
        values = self.sample(splat.texture, place, has_slopes=False) if splat.texture and place else []
        colors = [self.gather(channel, blocks, self.block_reals) for channel in channels]
        state = [self.gather(self.transmittance, blocks, self.block_reals), vector.is_live, *colors]
        at_pixel = [*splat.planes, *splat.spread, *values, vector.x, vector.y, *state]
        transmittance, still_live, *totals = self.lanes.emit(self.functions.forward, at_pixel)
        self.store_state(vector, transmittance, still_live)
        for total, channel in zip(totals, channels, strict=True):
            self.scatter(total, channel, blocks)


class _Backward(_Pass):
    """Pass that computes cotangents of the splats and of the texels, and the statistic."""

    rows_of_splats = ("splats", "d_splats")

    def write(self) -> None:
        b = self.b
        settings = self.settings
        self.suffix_sum = self.variable(self.block_reals, self.num_blocks + 1)
        self.g = [self.variable(self.block_reals, self.num_blocks + 1) for _ in range(settings.num_channels)]
        self.sums = self.variable(self.reals, self.num_sums)
        for k in range(self.num_sums):
            self.store(self.lanes.constant(0.0, self.real), self.sums, k)
        self.any_contributes = self.variable(BOOL)
        for tile, tile_numbers in self.tiles():
            self.begin_tile(tile_numbers)
            self.read_tile(tile, [self.suffix_sum], self.arguments["suffix_sum"])
            self.read_tile(tile, self.g, self.arguments["g"])
            for listed in self.splats(tile, tile_numbers):
                splat = self.prepare(listed, tile_numbers)
                jacobian = [self.load(self.arguments["jacobian"], k, self.real) for k in range(9)]
                same_everywhere = self.spread([*tile_numbers, *jacobian])
                *rows, d_texture = self.rows_of(listed, splat.texture)
                b.store(BOOL(0), self.any_contributes)
                # Planes, all numbers but the homography, three of the statistic and the number of pixels.
                num_totals = self.functions.num_planes + (len(listed.numbers) - 9) + (4 if settings.statistic else 0)
                totals = [self.variable(self.block_reals) for _ in range(num_totals)]
                for total in totals:
                    b.store(self.block.constant(0.0, self.real), total)
                for vector in self.touched_vectors(splat):
                    self.pull_back(splat, vector, same_everywhere, totals, d_texture)
                # Sums over lanes take as long as a vector of pixels: once per splat and tile, and only if needed.
                with b.if_then(b.load(self.any_contributes, typ=BOOL)):
                    self.add_totals(rows, listed.numbers, tile_numbers, totals)
                    if d_texture:
                        self.finish_texels(d_texture)

    def read_tile(self, tile: ir.Value, arrays: Sequence[ir.Value], source: ir.Value) -> None:
        num_pixels = self.settings.num_pixels
        base = self.at(source, self.times(tile, num_pixels * len(arrays)), self.real)
        for index, array in enumerate(arrays):
            # Lanes past the last pixel are never live, but are computed: they must not hold NaN from another tile.
            with self.loop(LONG(num_pixels), LONG((self.num_blocks + 1) * self.block.width)) as (k, _):
                self.store(self.real(0.0), array, k)
            with self.loop(LONG(0), LONG(num_pixels)) as (k, _):
                self.store(self.load(base, self.pixel(k, index), self.real), array, k)

    def pull_back(
        self, splat: _PreparedSplat, vector: _Vector, same_everywhere: Sequence[ir.Value], totals: Sequence[ir.Value],
        d_texture: NativeTexture | None,
    ) -> None:  # fmt: skip
        """Add the cotangents of a splat at a vector of pixels to the totals, and its texels' to theirs."""
        b = self.b
        lanes = self.lanes
        place = vector.place
        sample = self.sample(splat.texture, place, has_slopes=True) if splat.texture and place else []
        arrays = [self.transmittance, self.suffix_sum, *self.g]
        at_blocks = [self.gather(array, vector.blocks, self.block_reals) for array in arrays]
        transmittance, suffix_sum, *cotangents = at_blocks
        at_pixel = [*splat.planes, *splat.spread, *splat.spread_region, *sample, vector.x, vector.y]
        at_pixel += [transmittance, vector.is_live, suffix_sum, *cotangents, *same_everywhere]
        transmittance, still_live, suffix_sum, contributes, *rest = lanes.emit(self.functions.backward, at_pixel)
        self.store_state(vector, transmittance, still_live)
        self.scatter(suffix_sum, self.suffix_sum, vector.blocks)
        d_values = rest[: self.num_values]
        sums = rest[self.num_values :]
        settings = self.settings
        if settings.statistic:
            sums.append(lanes.constant(1.0, self.real))
        # Selected, not multiplied: the cotangents of a pixel that shows nothing may not be finite.
        chosen = functools.partial(b.select, contributes, rhs=lanes.constant(0.0, self.real))
        with b.if_then(lanes.any(contributes)):
            b.store(BOOL(1), self.any_contributes)
            for total, value in zip(totals, sums, strict=True):
                if settings.only_colors and isinstance(value, ir.Constant):
                    continue  # Zero.
                so_far = b.load(total, typ=self.block_reals)
                for part, is_chosen in zip(self.parts(value), self.parts(contributes), strict=True):
                    so_far = b.select(is_chosen, b.fadd(so_far, part), so_far)
                b.store(so_far, total)
            if d_texture and place:
                self.add_to_texels(d_texture, place, [chosen(value) for value in d_values])

    def rows_of(
        self, splat: _ListedSplat, texture: NativeTexture | None
    ) -> tuple[ir.Value, ir.Value, NativeTexture | None]:
        """Return the addresses to which a pair adds the cotangents of its splat's numbers, the statistic, and the
        cotangents of its texels, if the appearance has textures."""
        b = self.b
        arguments = self.arguments
        place = self.long(self.load(arguments["places"], splat.position, INT))
        is_own = b.icmp_signed("<", place, LONG(0))
        # Selects of addresses, not a branch: the code that adds is there once.
        row = b.select(is_own, splat.id, place)
        splats, texels, probe = (
            b.select(is_own, arguments[f"d_{name}"], arguments[f"more_{name}"])
            for name in ("splats", "texels", "probe")
        )
        if texture:
            own_first = self.long(self.load(arguments["regions"], self.times(splat.id, 3), INT))
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
        sums = self.block.sums([self.b.load(total, typ=self.block_reals) for total in totals])
        d_planes = sums[: functions.num_planes]
        others = sums[functions.num_planes :]
        d_splats, d_probe = rows
        if self.settings.only_colors:
            # Behind the opacity, here and in the row.
            self.add_to_row(d_splats, others[1 : 1 + self.settings.num_colors], first=10)
            return
        # All pixels of a tile share the planes: their cotangents are summed first, and pulled back to M once.
        d_M = self.scalars.emit(functions.prepare_vjp, [*numbers[:9], *tile, *d_planes])
        num_others = len(numbers) - 9
        self.add_to_row(d_splats, [*d_M, *others[:num_others]])
        # The statistic, if any, is behind the numbers of the splat.
        self.add_to_row(d_probe, others[num_others:])

    def add_to_row(self, row: ir.Value, values: Sequence[ir.Value], first: int = 0) -> None:
        """Add numbers to those in memory from an address on, from the number `first` on."""
        for k, value in enumerate(values, first):
            self.store(self.b.fadd(self.load(row, k, self.real), value), row, k)


@functools.cache
def compiled_pass(name: Literal["forward", "backward"], kernel: PassSettings) -> CompiledFunction:
    """Return a pass of a kernel, compiled at the first call."""
    module = ir.Module(name)
    writers: dict[str, tuple[type[_Forward] | type[_Backward], tuple[str, ...]]]
    writers = {"forward": (_Forward, FORWARD), "backward": (_Backward, BACKWARD)}
    writer, buffers = writers[name]
    function = llvm_code.unique(name)
    writer(PixelFunctions(kernel), module, function, buffers).write()
    (compiled,) = llvm_code.compiled(module, {function: (len(buffers), len(INTEGERS))})
    return compiled
