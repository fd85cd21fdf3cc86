"""Reading the table of an appearance rule from vector code, and adding to its cotangents."""

import functools
from collections.abc import Sequence

from llvmlite import ir

from a2tg_jax.kernels.lanes import INT, Lanes
from a2tg_jax.kernels.writer import Writer


class TableWriter(Writer):
    """A function whose buffers "table" and "d_table" are [entries, C], and which is told the number of entries.

    Every lane of a vector reads the entries of its own taps; C columns of a tap make C vectors.
    """

    lanes: Lanes
    reals: ir.Type
    num_columns: int

    def entries(self, taps: Sequence[ir.Value]) -> list[ir.Value]:
        """The table's entries that a vector reads, kept inside the table whatever a lane holds."""
        most = self.lanes.splat(self.b.sub(self.arguments["entries"], INT(1)))
        return [self.lanes.larger(self.lanes.smaller(tap, most), self.lanes.constant(0, INT)) for tap in taps]

    def is_uniform(self, entries: Sequence[ir.Value]) -> ir.Value:
        """Whether all lanes read one and the same entry for all taps: a texture of one texel, or a large texel."""
        first = self.lanes.splat(self.b.extract_element(entries[0], INT(0)))
        is_other = [self.b.icmp_signed("!=", entry, first) for entry in entries]
        return self.b.not_(self.lanes.any(functools.reduce(self.b.or_, is_other)))

    def entry(self, name: str, id_: ir.Value) -> ir.Value:
        """The address of an entry of the table, or of its cotangents."""
        return self.at(self.arguments[name], self.times(self.long(id_), self.num_columns), self.real)

    def gather(self, entries: Sequence[ir.Value], is_uniform: ir.Value | None) -> list[ir.Value]:
        """C vectors for every tap."""
        if is_uniform is None:
            return []
        b = self.b
        rooms = [self.variable(self.reals) for _ in range(self.num_columns * len(entries))]
        with b.if_else(is_uniform) as (uniform, mixed):
            with uniform:
                base = self.entry("table", b.extract_element(entries[0], INT(0)))
                numbers = [self.lanes.splat(self.load(base, k, self.real)) for k in range(self.num_columns)]
                for room, number in zip(rooms, numbers * len(entries), strict=True):
                    b.store(number, room)
            with mixed:
                vector = ir.VectorType(self.real, self.num_columns)
                columns: list[ir.Value] = []
                for entry in entries:
                    bases = [self.entry("table", b.extract_element(entry, INT(k))) for k in range(self.lanes.width)]
                    columns += self.transpose([self.load(base, 0, vector) for base in bases])
                for room, column in zip(rooms, columns, strict=True):
                    b.store(column, room)
        return [b.load(room, typ=self.reals) for room in rooms]

    def transpose(self, entries: Sequence[ir.Value]) -> list[ir.Value]:
        """L vectors of C as C vectors of L."""
        if self.num_columns != 4 or self.lanes.width % 4:
            return self.rearrange(entries, self.lanes.width)
        return self.transpose_quarters([self.concatenate(entries[k::4]) for k in range(4)])

    def transpose_back(self, columns: Sequence[ir.Value]) -> list[ir.Value]:
        """C vectors of L as L vectors of C."""
        width = self.lanes.width
        if self.num_columns != 4 or width % 4:
            return self.rearrange(columns, self.num_columns)
        quarters = self.transpose_quarters(columns)
        masks = [ir.Constant(ir.VectorType(INT, 4), list(range(first, first + 4))) for first in range(0, width, 4)]
        return [self.b.shuffle_vector(quarters[k], quarters[k], mask) for mask in masks for k in range(4)]

    def rearrange(self, vectors: Sequence[ir.Value], width: int) -> list[ir.Value]:
        """The transpose of any number of vectors, element by element; `width` is how many there are."""
        rows = []
        for k in range(vectors[0].type.count):
            row = ir.Constant(ir.VectorType(self.real, width), ir.Undefined)
            for place, vector in enumerate(vectors):
                row = self.b.insert_element(row, self.b.extract_element(vector, INT(k)), INT(place))
            rows.append(row)
        return rows

    def transpose_quarters(self, vectors: Sequence[ir.Value]) -> list[ir.Value]:
        """Four vectors, every four lanes of them transposed as a 4×4 matrix."""
        low01, low23 = (self.shuffle(vectors[k], vectors[k + 1], (0, "0", 1, "1")) for k in (0, 2))
        high01, high23 = (self.shuffle(vectors[k], vectors[k + 1], (2, "2", 3, "3")) for k in (0, 2))
        first, second = (0, 1, "0", "1"), (2, 3, "2", "3")
        pairs = (low01, low23, first), (low01, low23, second), (high01, high23, first), (high01, high23, second)
        return [self.shuffle(*pair) for pair in pairs]

    def shuffle(self, x: ir.Value, y: ir.Value, pattern: Sequence[int | str]) -> ir.Value:
        """The pattern in every four lanes; numbers are lanes of x, strings of y."""
        width = self.lanes.width
        mask = [
            quarter + (width + int(lane) if isinstance(lane, str) else lane)
            for quarter in range(0, width, 4)
            for lane in pattern
        ]
        return self.b.shuffle_vector(x, y, ir.Constant(ir.VectorType(INT, width), mask))

    def concatenate(self, pieces: Sequence[ir.Value]) -> ir.Value:
        pieces = list(pieces)
        while len(pieces) > 1:
            count = pieces[0].type.count * 2
            mask = ir.Constant(ir.VectorType(INT, count), list(range(count)))
            pieces = [self.b.shuffle_vector(*pieces[k : k + 2], mask) for k in range(0, len(pieces), 2)]
        return pieces[0]

    def scatter(self, entries: Sequence[ir.Value], is_uniform: ir.Value | None, d_values: Sequence[ir.Value]) -> None:
        """Adds the cotangents of what was gathered, lane after lane, in order."""
        if is_uniform is None:
            return
        b, columns = self.b, self.num_columns
        by_tap = [d_values[k : k + columns] for k in range(0, len(d_values), columns)]
        with b.if_else(is_uniform) as (uniform, mixed):
            with uniform:
                sums = [functools.reduce(b.fadd, same) for same in zip(*by_tap, strict=True)]
                total = functools.reduce(b.fadd, self.transpose_back(sums))
                self.add_entry(b.extract_element(entries[0], INT(0)), total)
            with mixed:
                for entry, vectors in zip(entries, by_tap, strict=True):
                    for lane, row in enumerate(self.transpose_back(vectors)):
                        self.add_entry(b.extract_element(entry, INT(lane)), row)

    def add_entry(self, id_: ir.Value, addend: ir.Value) -> None:
        base = self.entry("d_table", id_)
        self.store(self.b.fadd(self.load(base, 0, addend.type), addend), base, 0)
