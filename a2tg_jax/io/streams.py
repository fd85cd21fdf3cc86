"""Named columns of numbers in one body of coded bytes: a writer, and a reader that unpacks no more than it may.

Both go through the columns in one order. What the reader must know beside the bytes is in `Layout`, which is JSON-able.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from a2tg_jax.io import quantise
from a2tg_jax.io.coders import CODERS, Choice, CodedError, decode, encode, encode_smallest
from a2tg_jax.io.quantise import Contraction, Ends, Precision

MEANS_FLOAT_BITS = 16
"""Bits of a place along the Z curve if means are kept as floats."""


@dataclasses.dataclass
class Layout:
    """Description of the coded bytes."""

    lengths: dict[str, int] = dataclasses.field(default_factory=dict)
    """Coded bytes by name, in order."""
    coders: dict[str, str] = dataclasses.field(default_factory=dict)
    """Coder of each part, by name."""
    ends: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    """Smallest and largest of each group kept in bits; for each axis of the means, centre and spread come first."""


class ColumnWriter:
    """Writer of coded columns, one after the other.

    Args:
      coder: of all parts.
      ends: ends of groups kept in bits, as in `Layout.ends`; those of other groups follow from their numbers.
    """

    def __init__(self, coder: Choice, ends: Mapping[str, Sequence[float]] = MappingProxyType({})):
        self.coder = coder
        self.layout = Layout()
        self._known_ends = ends
        self.num_unpacked = 0
        """Bytes before coding."""
        self._pieces: list[bytes] = []

    @property
    def body(self) -> bytes:
        return b"".join(self._pieces)

    def planes(self, name: str, planes: np.ndarray) -> None:
        """Write uint8 [C, n]."""
        coder = self.coder
        if coder == "smallest":
            coder, piece = encode_smallest(planes)
        else:
            piece = encode(coder, planes)
        self._pieces.append(piece)
        self.layout.coders[name] = coder
        self.layout.lengths[name] = len(piece)
        self.num_unpacked += planes.size

    def exact(self, name: str, values: np.ndarray) -> None:
        """Write numbers of any shape and type exactly."""
        self.planes(name, quantise.to_byte_planes(values.reshape(1, -1)))

    def indices(self, name: str, indices: np.ndarray, count: int) -> None:
        """Write [n] integers below `count`; no bytes if there is one."""
        self.planes(name, quantise.to_planes(indices, _bits_of_indices(count)))

    def numbers(self, name: str, values: np.ndarray, precision: Precision, *, is_color: bool = False) -> None:
        """Write floats [C, n]. The three columns of colours are red, green, blue.

        Raises:
          ValueError: if float16 cannot hold them.
        """
        if not isinstance(precision, int):
            self.planes(name, quantise.to_byte_planes(_as_float(name, values, precision)))
            return
        ends = Ends(*self._known_ends[name]) if name in self._known_ends else quantise.ends_of(values, precision)
        self.layout.ends[name] = list(ends)
        if ends.low == ends.high:
            self.planes(name, np.zeros((0, values.shape[1]), np.uint8))
            self.num_unpacked += values.size
            return
        codes = quantise.quantised(values, ends, precision)
        codes = quantise.green_apart(codes, precision) if is_color else codes
        self.planes(name, quantise.to_planes(codes, precision))

    def means(self, name: str, values: np.ndarray, precision: Precision) -> np.ndarray:
        """Write positions [3, n], and return their order [n] along the Z curve."""
        bits = precision if isinstance(precision, int) else MEANS_FLOAT_BITS
        known = np.reshape(self._known_ends.get(name, ()), (-1, 4)).tolist()
        contractions = [Contraction(*own[:2]) for own in known] or [Contraction.of(axis) for axis in values]
        contracted = [of.contracted(axis) for of, axis in zip(contractions, values, strict=True)]
        ends = [Ends(*own[2:]) for own in known] or [quantise.ends_of(axis, bits) for axis in contracted]
        codes = [quantise.quantised(axis, end, bits) for axis, end in zip(contracted, ends, strict=True)]
        key = quantise.morton(np.stack(codes), bits)
        order = np.argsort(key, kind="stable")
        if precision != bits:
            self.numbers(name, values[:, order], precision)
            return order
        pairs = zip(contractions, ends, strict=True)
        self.layout.ends[name] = [number for of, end in pairs for number in (*of, *end)]
        self.planes(name, quantise.to_planes(np.diff(key[order], prepend=0), 3 * bits))
        return order


class ColumnReader:
    """Reads what a `ColumnWriter` wrote, in the same order.

    Args:
      body: the coded bytes.
      layout: what was written beside them.
      room: so many bytes may be unpacked in all.

    Raises:
      ValueError: if the lengths are not those of the body.
    """

    def __init__(self, body: bytes, layout: Layout, room: int):
        lengths = list(layout.lengths.values())
        if not all(type(length) is int and length >= 0 for length in lengths) or sum(lengths) != len(body):
            raise ValueError(f"its parts must have {len(body)} bytes in all; got {lengths}")
        self.layout, self.room = layout, room
        self._body, self._at = body, 0
        self._names = list(layout.lengths)

    def planes(self, name: str, num_planes: int, length: int) -> np.ndarray:
        """Read uint8 [num_planes, length].

        Raises:
          ValueError: if the next part is another, is damaged, or there is no room left.
        """
        self.take_room(name, num_planes * length)
        if not self._names or self._names[0] != name:
            raise ValueError(f"the part {name} is missing; {self._names[:1]} came")
        size, coder = self.layout.lengths[self._names.pop(0)], self.layout.coders[name]
        if coder not in CODERS:
            raise ValueError(f"the part {name} is of the coder {coder}, which is not known here")
        data = self._body[self._at : self._at + size]
        self._at += size
        try:
            return decode(coder, data, num_planes, length)
        except CodedError as error:
            raise ValueError(f"the part {name} {error}") from error

    def take_room(self, name: str, num_bytes: int) -> None:
        """Raise ValueError if these are more bytes than a file of this size may unpack to."""
        if num_bytes > self.room:
            raise ValueError(f"{name} would take {num_bytes} bytes, which the file is too small for")
        self.room -= num_bytes

    def end(self) -> None:
        """Raise ValueError unless all parts were read."""
        if self._names:
            raise ValueError(f"the part {self._names[0]} is not known")

    def exact(self, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        planes = self.planes(name, np.dtype(dtype).itemsize, math.prod(shape))
        values = quantise.from_byte_planes(planes, 1, np.dtype(dtype)).reshape(shape)
        return values.astype(np.dtype(dtype))

    def indices(self, name: str, length: int, count: int) -> np.ndarray:
        bits = _bits_of_indices(count)
        if count == 0 and length:
            raise ValueError(f"{name} are of a table that is empty")
        self.take_room(name, length)
        indices: np.ndarray = quantise.from_planes(self.planes(name, quantise.num_bytes_of(bits), length), 1)[0]
        if length and indices.max() >= count:
            raise ValueError(f"{name} must be below {count}; got {indices.max()}")
        return indices

    def numbers(
        self, name: str, num_columns: int, length: int, precision: Precision, *, is_color: bool = False
    ) -> np.ndarray:
        """Read float32 [num_columns, length]."""
        if not isinstance(precision, int):
            dtype = np.dtype(precision)
            planes = self.planes(name, num_columns * dtype.itemsize, length)
            return _finite(name, quantise.from_byte_planes(planes, num_columns, dtype))
        ends = Ends(*_numbers(name, self.layout.ends[name], 2))
        if ends.low == ends.high:
            self.take_room(name, num_columns * length)
            self.planes(name, 0, length)
            return np.full((num_columns, length), ends.low, np.float32)
        num_planes = num_columns * quantise.num_bytes_of(precision)
        codes = quantise.from_planes(self.planes(name, num_planes, length), num_columns)
        codes = quantise.with_green(codes, precision) if is_color else codes
        return _finite(name, quantise.dequantised(codes, ends, precision))

    def means(self, name: str, length: int, precision: Precision) -> np.ndarray:
        """Read float32 [3, length]."""
        if not isinstance(precision, int):
            return self.numbers(name, 3, length, precision)
        known = np.reshape(_numbers(name, self.layout.ends[name], 12), (3, 4)).tolist()
        planes = self.planes(name, quantise.num_bytes_of(3 * precision), length)
        with np.errstate(over="ignore"):
            key = np.cumsum(quantise.from_planes(planes, 1)[0])
            codes = quantise.from_morton(key, precision)
            axes = [
                Contraction(centre, spread).expanded(quantise.dequantised(axis, Ends(low, high), precision))
                for axis, (centre, spread, low, high) in zip(codes, known, strict=True)
            ]
        return _finite(name, np.stack(axes))


def _bits_of_indices(count: int) -> int:
    return max(count - 1, 0).bit_length()


def _numbers(name: str, found: Any, count: int) -> list[float]:
    """Return finite numbers of a header."""
    is_right = isinstance(found, list) and len(found) == count and all(type(x) in (int, float) for x in found)
    if not is_right or not all(abs(x) <= quantise.LARGEST_FLOAT for x in found):
        raise ValueError(f"the ends of {name} must be {count} numbers; got {found}")
    return [float(x) for x in found]


def _as_float(name: str, values: np.ndarray, precision: str) -> np.ndarray:
    with np.errstate(over="ignore"):
        return _finite(name, np.asarray(values), np.dtype(precision))


def _finite(name: str, values: np.ndarray, dtype: Any = np.float32) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        values = values.astype(dtype)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite as {np.dtype(dtype)}; some are not")
    return values
