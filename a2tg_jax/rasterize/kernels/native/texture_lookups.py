"""Texture lookups in vector code without gathers: reads of the splats' textures, and sums of their cotangents.

Every texel that a vector of L neighbouring pixels may see is loaded once for all lanes, and each lane weighs it by its
distance. The sum is the one over four corners in `core.bilinear`. Textures of up to 4×4 texels are visited whole, with
code unrolled along a row; in larger ones, the texels between the least and the largest coordinate of the lanes are.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from llvmlite import ir

from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import INT, LONG, Writer

EMPTY = 0
"""Width of a texture without texels."""
SMALL_WIDTHS = (1, 2, 4)
"""Widths of small textures, whose height is at most the largest of these."""
SMALL_HEIGHT = max(SMALL_WIDTHS)


class NativeTexture(NamedTuple):
    """Place of a splat's texture among all texels, or of its cotangents among theirs."""

    first: ir.Value  # address of its first texel
    height: ir.Value  # height in texels, a 64-bit integer
    width: ir.Value  # width in texels, a 64-bit integer


class Place(NamedTuple):
    """Positions of L lanes in a texture."""

    x: ir.Value  # horizontal coordinates in texels
    y: ir.Value  # vertical coordinates in texels
    is_reached: ir.Value  # mask of the lanes whose pixel the splat may reach


class Line(NamedTuple):
    index: ir.Value  # number of the row or column
    weight: ir.Value  # weight max(0, 1 − |distance|) in each lane
    slope: ir.Value | None  # derivative of the weight within the cell; None if it is zero or not requested


class TexelWriter(Writer):
    """Writer of a function that reads textures in texels [T, C], or adds to their cotangents."""

    lanes: Lanes  # operations on vectors of L pixels
    reals: ir.Type  # type of a vector of L floats
    num_values: int  # number C of numbers per texel
    empty: Sequence[float]  # C values of a splat without a texture; empty if all splats have one
    sums: ir.Value  # cotangents of a small texture's texels in each lane, `num_sums` vectors; zero before a splat

    @property
    def num_sums(self) -> int:
        """Number of vectors in `sums`: C for every texel of the largest small texture."""
        return SMALL_HEIGHT * max(SMALL_WIDTHS) * self.num_values

    @property
    def small_widths(self) -> tuple[int, ...]:
        """Widths of small textures, with `EMPTY` if there may be textures without texels."""
        return (EMPTY, *SMALL_WIDTHS) if self.empty else SMALL_WIDTHS

    def texture(self, texels: ir.Value, first: ir.Value, height: ir.Value, width: ir.Value) -> NativeTexture:
        """Return the texture that begins with texel `first`."""
        return NativeTexture(self.at(texels, self.times(first, self.num_values), self.real), height, width)

    def sample(self, texture: NativeTexture, place: Place, has_slopes: bool) -> list[ir.Value]:
        """Return C interpolated values and, with slopes, their C derivatives along x and C along y."""
        count = self.num_values
        num_slopes = count if has_slopes else 0
        values = self.zeros(count)
        along_x = self.zeros(num_slopes)
        along_y = self.zeros(num_slopes)
        for width in self.cases(texture):
            if width == EMPTY:
                for number, value in zip(self.empty, values, strict=True):
                    self.b.store(self.lanes.constant(number, self.real), value)
                continue
            for row in self.rows(texture, width, place, has_slopes):
                # Bilinear weights are products: a row is summed by the columns' weights, and weighed once.
                in_row = self.zeros(count)
                in_row_along_x = self.zeros(num_slopes)
                for column in self.columns(texture, width, place, has_slopes):
                    texel = self.texel(texture, column, row)
                    numbers = [self.lanes.broadcast(self.load(texel, k, self.real)) for k in range(count)]
                    self.accumulate(in_row, column.weight, numbers)
                    self.accumulate(in_row_along_x, column.slope, numbers)
                numbers = self.loads(in_row)
                self.accumulate(values, row.weight, numbers)
                self.accumulate(along_y, row.slope, numbers)
                self.accumulate(along_x, row.weight, self.loads(in_row_along_x))
        return self.loads([*values, *along_x, *along_y])

    def add_to_texels(self, texture: NativeTexture, place: Place, d_values: Sequence[ir.Value]) -> None:
        """Add the cotangents of C values, zero in lanes that do not count; `finish_texels` completes the sum."""
        for width in self.cases(texture):
            if width == EMPTY:
                continue
            for row in self.rows(texture, width, place, False):
                in_row = [self.product(row.weight, d_value) for d_value in d_values]
                for column in self.columns(texture, width, place, False):
                    addends = [self.product(column.weight, d_value) for d_value in in_row]
                    if width is None:
                        self.add_sums(self.texel(texture, column, row), addends)
                        continue
                    # Lanes are summed once per splat and tile, not once per vector of pixels.
                    texel = self.b.add(self.times(row.index, width), column.index)
                    for k, addend in enumerate(addends):
                        index = self.b.add(self.times(texel, self.num_values), LONG(k))
                        self.store(self.b.fadd(self.load(self.sums, index, self.reals), addend), self.sums, index)

    def finish_texels(self, texture: NativeTexture) -> None:
        """Add the lanes' sums of a small texture to the cotangents of its texels."""
        b = self.b
        zero = self.lanes.constant(0.0, self.real)
        num = b.select(
            b.icmp_signed(">", self.small_width(texture), LONG(0)), b.mul(texture.height, texture.width), LONG(0)
        )
        with self.loop(LONG(0), num) as (place, _):
            base = self.at(self.sums, self.times(place, self.num_values), self.reals)
            addends = [self.load(base, k, self.reals) for k in range(self.num_values)]
            for k in range(self.num_values):
                self.store(zero, base, k)
            self.add_sums(self.entry(texture, place), addends)

    def small_width(self, texture: NativeTexture) -> ir.Value:
        """Return the width of a small texture; −1 for a large one."""
        b = self.b
        is_width = [b.icmp_signed("==", texture.width, LONG(width)) for width in self.small_widths]
        is_low = b.icmp_signed("<=", texture.height, LONG(SMALL_HEIGHT))
        return b.select(b.and_(is_low, functools.reduce(b.or_, is_width)), texture.width, LONG(-1))

    def cases(self, texture: NativeTexture) -> Iterator[int | None]:
        """Write branches, which the caller fills: one per width of a small texture, and one (None) for large ones."""
        b = self.b
        large = b.append_basic_block("large")
        end = b.append_basic_block("end")
        switch = b.switch(self.small_width(texture), large)
        for width in (*self.small_widths, None):
            block = large if width is None else b.append_basic_block(f"width{width}")
            if width is not None:
                switch.add_case(LONG(width), block)
            b.position_at_end(block)
            yield width
            b.branch(end)
        b.position_at_end(end)

    def rows(self, texture: NativeTexture, width: int | None, place: Place, has_slope: bool) -> Iterator[Line]:
        """Write a loop, which the caller fills, over the rows that may be seen; over all of a small texture."""
        if width is None:
            span, y = self.seen(place.y, place.is_reached, texture.height)
        else:
            span = (LONG(0), texture.height)
            y = place.y
        with self.loop(*span) as (index, _):
            yield self.line(index, y, texture.height, has_slope)

    def columns(self, texture: NativeTexture, width: int | None, place: Place, has_slope: bool) -> Iterator[Line]:
        """Write a loop, which the caller fills, over the columns that may be seen; unrolled for a small texture."""
        if width is None:
            span, x = self.seen(place.x, place.is_reached, texture.width)
            with self.loop(*span) as (index, _):
                yield self.line(index, x, texture.width, has_slope)
        elif width == 1:
            yield Line(LONG(0), self.lanes.constant(1.0, self.real), None)
        else:
            for k in range(width):
                yield self.line(LONG(k), place.x, LONG(width), has_slope)

    def seen(
        self, places: ir.Value, is_reached: ir.Value, size: ir.Value
    ) -> tuple[tuple[ir.Value, ir.Value], ir.Value]:
        """Return the first texel along an axis that the reached lanes see, and the end, which is excluded; and all
        lanes' places, moved between the reached ones."""
        b = self.b
        number = functools.partial(self.lanes.constant, scalar=self.real)
        # An axis without texels has an empty range, not one that begins before the first texel.
        last = b.select(b.icmp_signed(">", size, LONG(0)), b.sub(size, LONG(1)), LONG(0))
        most = self.lanes.broadcast(b.sitofp(last, self.real))
        # Clipped, so that no lane reads outside the texture, even if it holds NaN.
        places = b.select(b.fcmp_ordered(">", places, number(0.0)), places, number(0.0))
        places = b.select(b.fcmp_ordered("<", places, most), places, most)
        least = self.lanes.fold(b.select(is_reached, places, most), self.lanes.smaller)
        largest = self.lanes.fold(b.select(is_reached, places, number(0.0)), self.lanes.larger)
        # The last texel with a weight is ⌊largest⌋ + 1.
        end = b.add(b.fptosi(largest, LONG), LONG(2))
        end = b.select(b.icmp_signed("<", end, size), end, size)
        # Other lanes are composited too. They show nothing, as the cutoff says, if their values are averages of texels.
        places = self.lanes.larger(places, self.lanes.broadcast(least))
        return (b.fptosi(least, LONG), end), self.lanes.smaller(places, self.lanes.broadcast(largest))

    def line(self, index: ir.Value, places: ir.Value, size: ir.Value, has_slope: bool) -> Line:
        """Return one of `size` rows or columns, seen from `places`."""
        b = self.b
        number = functools.partial(self.lanes.constant, scalar=self.real)
        distance = b.fsub(places, self.lanes.broadcast(b.sitofp(index, self.real)))
        weight = self.lanes.larger(b.fsub(number(1.0), self.lanes.intrinsic("fabs", [distance])), number(0.0))
        if not has_slope:
            return Line(index, weight, None)
        # Beyond the last texel the texture is constant.
        is_last = b.icmp_signed("==", index, b.sub(size, LONG(1)))
        falling = self.lanes.broadcast(b.select(is_last, self.real(0.0), self.real(-1.0)))
        # d(1 − |distance|)/dx: +1 before the texel, −1 from it on, as the cell of ⌊x⌋ has it.
        slope = b.select(b.fcmp_ordered("<", distance, number(0.0)), number(1.0), falling)
        is_in_cell = b.fcmp_ordered("<", distance, number(1.0)), b.fcmp_ordered(">=", distance, number(-1.0))
        return Line(index, weight, b.select(b.and_(*is_in_cell), slope, number(0.0)))

    def texel(self, texture: NativeTexture, column: Line, row: Line) -> ir.Value:
        return self.entry(texture, self.b.add(self.b.mul(row.index, texture.width), column.index))

    def entry(self, texture: NativeTexture, index: ir.Value) -> ir.Value:
        """Return the address of a texel, counted row by row."""
        return self.at(texture.first, self.times(index, self.num_values), self.real)

    def add_sums(self, entry: ir.Value, vectors: Sequence[ir.Value]) -> None:
        """Add the sums over lanes of C vectors to a texel."""
        b = self.b
        for first in range(0, len(vectors), self.lanes.width):
            some = vectors[first : first + self.lanes.width]
            sums = self.lanes.sums_in_lanes(some)
            sums = b.shuffle_vector(sums, sums, ir.Constant(ir.VectorType(INT, len(some)), [*range(len(some))]))
            base = self.at(entry, LONG(first), self.real)
            self.store(b.fadd(self.load(base, 0, sums.type), sums), base, 0)

    def accumulate(self, totals: Sequence[ir.Value], weight: ir.Value | None, numbers: Sequence[ir.Value]) -> None:
        """Add weight·numbers to the totals; a weight of None is zero."""
        if weight is None:
            return
        for total, number in zip(totals, numbers, strict=True):
            sum_so_far = self.b.load(total, typ=self.reals)
            self.b.store(self.sum(sum_so_far, self.product(weight, number)), total)

    def zeros(self, num: int) -> list[ir.Value]:
        """Return variables of one vector each, set to zero at this point."""
        slots = [self.variable(self.reals) for _ in range(num)]
        for slot in slots:
            self.b.store(self.lanes.constant(0.0, self.real), slot)
        return slots

    def loads(self, slots: Sequence[ir.Value]) -> list[ir.Value]:
        return [self.b.load(slot, typ=self.reals) for slot in slots]
