"""Headers of PLY files, and the sizes of their elements."""

import dataclasses
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from a2tg_jax.host.text import shortened

OLD_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
NEW_TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
NUMPY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
PLY_TYPES = dict(zip(OLD_TYPES + NEW_TYPES, NUMPY_TYPES * 2, strict=True))
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_LINE, MOST_LINES = 4096, 10_000
LEAST_BYTES = 2
"""Least number of bytes of a number in text: a digit and a separator."""
MOST_DIGITS = 20
OFFSET = "offset"
"""First word of the comment that says what positions are relative to."""


@dataclasses.dataclass(frozen=True)
class VertexHeader:
    """Header of a PLY file's vertices."""

    path: Path
    encoding: str
    """One of `BYTE_ORDERS`."""
    count: int
    fields: dict[str, str]
    """NumPy type name of each property, in order."""

    @property
    def dtype(self) -> np.dtype:
        """Bytes of one vertex in a binary file."""
        return np.dtype([(name, BYTE_ORDERS[self.encoding] + kind) for name, kind in self.fields.items()])

    def require(self, names: Iterable[str], wanted: str) -> None:
        """Raise ValueError unless the vertices have some properties."""
        missing = [name for name in names if name not in self.fields]
        if missing:
            raise ValueError(f"{self.path}: has no attribute {', '.join(missing)}; {wanted} is expected")

    def read(self, file: BinaryIO) -> np.ndarray:
        """Return the structured vertices [count]; float64 from text. Raise ValueError if they are truncated."""
        return self._read_ascii(file) if self.encoding == "ascii" else self.read_binary(file)

    def _read_ascii(self, file: BinaryIO) -> np.ndarray:
        """Return the vertices of a text file, one per line."""
        num = len(self.fields)
        self.check_room(file, LEAST_BYTES * num - 1)
        rows = np.empty((self.count, num))
        try:
            for row in rows:
                row[:] = [float(word) for word in file.readline(LONGEST_LINE).split()[:num]]
        except ValueError:
            raise ValueError(f"{self.path}: a line of it is not a vertex of {num} numbers; export it again") from None
        return rows.view([(name, np.float64) for name in self.fields])[:, 0]

    def read_binary(self, file: BinaryIO) -> np.ndarray:
        """Return the structured vertices [count] of a binary file. Raise ValueError if it is truncated."""
        dtype = self.dtype
        self.check_room(file, dtype.itemsize)
        return np.frombuffer(file.read(self.count * dtype.itemsize), dtype, self.count)

    def check_room(self, file: BinaryIO, num_bytes: int) -> None:
        """Raise ValueError if the rest of a file is too short for this number of bytes per vertex."""
        start = file.tell()
        left = file.seek(0, os.SEEK_END) - start
        file.seek(start)
        if self.count * num_bytes > left:
            raise ValueError(
                f"{self.path}: is cut off; {self.count} vertices of {num_bytes} bytes were announced, and {left} bytes "
                "are left; export it again"
            )


def read_vertex_header(file: BinaryIO, path: Path) -> VertexHeader:
    """Return the header of a PLY, with the file left at its first vertex.

    Raises:
      ValueError: naming the file, if it is no PLY, its header does not end, vertices are not its first element, or a
        property of them cannot be read.
    """
    encoding, count = "", 0
    elements: list[str] = []
    fields: dict[str, str] = {}
    for words in header_lines(file, path):
        match words:
            case ["format", encoding, *_] if encoding not in BYTE_ORDERS:
                raise ValueError(f"{path}: is a PLY in {shortened(encoding)}; {', '.join(BYTE_ORDERS)} are known")
            case ["element", name, number]:
                elements.append(name)
                if not number.isdecimal() or len(number) > MOST_DIGITS:
                    raise ValueError(f"{path}: announces {shortened(number)} of {name}; a number is expected")
                count = int(number) if len(elements) == 1 else count
            case ["property", kind, name] if elements == ["vertex"] and kind in PLY_TYPES and name not in fields:
                fields[name] = PLY_TYPES[kind]
            case ["property", *_] if elements == ["vertex"]:
                raise ValueError(f"{path}: cannot read the vertex property '{shortened(' '.join(words[1:]))}'")
    if elements[:1] != ["vertex"] or not encoding:
        raise ValueError(f"{path}: vertices must be the first element of the PLY; it has {shortened(elements)}")
    return VertexHeader(path, encoding, count, fields)


def read_headers(file: BinaryIO, path: Path) -> dict[str, VertexHeader]:
    """Return the headers of all elements of a PLY by name, with the file left at the first row.

    Raises:
      ValueError: naming the file, if it is no PLY, its header does not end, or a property cannot be read.
    """
    encoding, found = "", dict[str, VertexHeader]()
    for words in header_lines(file, path):
        match words:
            case ["format", name, *_]:
                if name not in BYTE_ORDERS:
                    raise ValueError(f"{path}: is a PLY in {shortened(name)}; {', '.join(BYTE_ORDERS)} are known")
                encoding = name
            case ["element", name, number]:
                if not number.isdecimal() or len(number) > MOST_DIGITS:
                    raise ValueError(
                        f"{path}: announces {shortened(number)} of {shortened(name)}; a number is expected"
                    )
                found[name] = VertexHeader(path, encoding, int(number), {})
            case ["property", kind, name] if found and kind in PLY_TYPES:
                list(found.values())[-1].fields[name] = PLY_TYPES[kind]
            case ["property", *_]:
                raise ValueError(f"{path}: cannot read the property '{shortened(' '.join(words[1:]))}'")
    return found


def offset_of(file: BinaryIO, path: Path) -> np.ndarray:
    """Return what the positions of a PLY are relative to, [3] float64: zeros without the comment "offset X Y Z"."""
    file.seek(0)
    for words in header_lines(file, path):
        if words[:2] == ["comment", OFFSET] and len(words) == 5:
            try:
                return np.array([float(word) for word in words[2:]])
            except ValueError:
                continue  # Words of another program.
    return np.zeros(3)


def header_lines(file: BinaryIO, path: Path) -> Iterator[list[str]]:
    """Yield the words of each line up to end_header."""
    if file.readline(LONGEST_LINE).strip() != b"ply":
        raise ValueError(f"{path}: is not a PLY file")
    for _ in range(MOST_LINES):
        line = file.readline(LONGEST_LINE)
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        if not line.endswith(b"\n"):
            break
        yield words
    raise ValueError(f"{path}: its PLY header does not end")
