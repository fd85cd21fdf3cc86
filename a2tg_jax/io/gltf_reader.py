"""Reads glTF 2.0 of strangers: *.glb, and *.gltf with its buffers; room is made for no more than a file can hold."""

import base64
import binascii
import os
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.host.json_text import parse_json
from a2tg_jax.host.regular_files import MOST_ARRAY_BYTES, is_regular, read_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.io.gltf_writer import BINARY_CHUNK, CHUNK, COMPONENTS, HEAD, JSON_CHUNK, MAGIC, SIDES, VERSION

MOST_STRIDE = 252
LARGEST_RATIO = 64
FREE_ROOM = 1 << 20
"""Bytes of numbers that a file may hold, as float32, beyond `LARGEST_RATIO` times its own."""
EMBEDDED = "base64,"
LONGEST_NAME = 255
"""Bytes that the name of a buffer may have."""


class Document:
    """A file that was read: its JSON, and the numbers of its accessors.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not glTF 2.0, or is damaged.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        if not is_regular(self.path):
            raise FileNotFoundError(f"{self.path}: no such glTF file")
        data = read_regular(self.path, MOST_ARRAY_BYTES)
        text, self._binary = _split_glb(data) if data[:4] == MAGIC else (data, None)
        self.json = parse_json(text)
        if not isinstance(self.json, dict) or not isinstance(self.json.get("asset"), dict):
            raise ValueError("is not glTF")
        if (version := self.json["asset"].get("version")) != "2.0":
            raise ValueError(f"is glTF of version {shortened(version)}; this program reads 2.0")
        self._buffers: dict[int, bytes] = {}
        self._files: dict[Path, bytes] = {}
        self._room = FREE_ROOM + LARGEST_RATIO * len(data)

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return an object of one of the lists of the file, such as "nodes"."""
        entries = self.json.get(kind, [])
        if type(index) is not int or not isinstance(entries, list) or not 0 <= index < len(entries):
            raise ValueError(f"has no {kind}[{shortened(index)}]")
        if not isinstance(entries[index], dict):
            raise ValueError(f"its {kind}[{index}] is no object")
        found: dict[str, Any] = entries[index]
        return found

    def numbers(self, index: Any, kinds: Sequence[str], what: str) -> np.ndarray:
        """Return the numbers of an accessor as float32 [n, columns]; integers that are normalised become fractions.

        Args:
          index: its index.
          kinds: types that it may have, such as "VEC3".
          what: its name in errors.

        Raises:
          ValueError: if there is none, it is of another type, or reaches beyond its buffer.
        """
        accessor = self.entry("accessors", index)
        if accessor.get("type") not in kinds or accessor.get("componentType") not in COMPONENTS:
            kind = f"{accessor.get('type')} of {accessor.get('componentType')}"
            raise ValueError(f"{what} must be {' or '.join(kinds)} of numbers; got {shortened(kind)}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"{what} is a sparse accessor, which this program does not read")
        dtype, columns = np.dtype(COMPONENTS[accessor["componentType"]]), SIDES[accessor["type"]]
        count = _count(accessor, "count", what)
        data, start, stop, stride = self._span(accessor, dtype.itemsize * columns, what)
        if count and start + stride * (count - 1) + dtype.itemsize * columns > stop:
            raise ValueError(f"{what} has {count} entries, but its buffer is too short for them")
        self._take_room(4 * count * columns, what)
        values = np.ndarray((count, columns), dtype, data, start if count else 0, (stride, dtype.itemsize))
        return _fractions(values) if accessor.get("normalized") is True else values.astype(np.float32)

    def _span(self, accessor: Mapping[str, Any], size: int, what: str) -> tuple[bytes, int, int, int]:
        """Return a buffer, the first and the last byte that an accessor may use, and the bytes from entry to entry."""
        view = self.entry("bufferViews", accessor["bufferView"])
        data = self._buffer(view.get("buffer"), what)
        start, length = _count(view, "byteOffset", what, 0), _count(view, "byteLength", what)
        stride = _count(view, "byteStride", what, size)
        if start + length > len(data):
            raise ValueError(f"{what} reaches beyond its buffer of {len(data)} bytes")
        if stride < size or stride > max(size, MOST_STRIDE):
            raise ValueError(f"{what} has a stride of {stride} bytes for {size}")
        return data, start + _count(accessor, "byteOffset", what, 0), start + length, stride

    def _take_room(self, num_bytes: int, what: str) -> None:
        if num_bytes > self._room:
            raise ValueError(f"{what} would take {num_bytes} bytes, which the file is too small for")
        self._room -= num_bytes

    def _buffer(self, index: Any, what: str) -> bytes:
        """Return the bytes of a buffer, which are read once."""
        described = self.entry("buffers", index)
        length = _count(described, "byteLength", what)
        if index not in self._buffers:
            uri = described.get("uri")
            if uri is None and (index != 0 or self._binary is None):
                raise ValueError(f"has no bytes for buffers[{index}]")
            self._buffers[index] = self._read(uri) if uri is not None else self._binary or b""
        if len(self._buffers[index]) < length:
            found = len(self._buffers[index])
            raise ValueError(f"is cut off: its buffer has {found} bytes where {length} are announced")
        return self._buffers[index]

    def _read(self, uri: Any) -> bytes:
        """Return the bytes of a buffer outside the file, which must lie in its folder, or embedded in its JSON."""
        if not isinstance(uri, str):
            raise ValueError("the uri of a buffer is no text")
        if uri.startswith("data:"):
            head, mark, text = uri.partition(EMBEDDED)
            try:
                return base64.b64decode(text, validate=True) if mark else urllib.parse.unquote_to_bytes(head[5:])
            except binascii.Error as error:
                raise ValueError(f"its embedded buffer is damaged ({error})") from error
        file = _named_file(self.path, uri)
        if file not in self._files:
            self._files[file] = read_regular(file, MOST_ARRAY_BYTES)
            self._room += LARGEST_RATIO * len(self._files[file])
        return self._files[file]


def buffer_files(path: Path) -> list[Path]:
    """Return the files beside a *.gltf that its buffers name; none if it cannot be read."""
    try:
        buffers = Document(path).json["buffers"]
        uris = {buffer["uri"]: None for buffer in buffers if not buffer.get("uri", "data:").startswith("data:")}
        return list({_named_file(path, uri): None for uri in uris})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def _named_file(path: Path, uri: str) -> Path:
    """Return the file of a buffer. Raises ValueError if it is missing or does not lie in the folder of the glTF."""
    name = urllib.parse.unquote(uri, errors="strict")
    if len(name.encode("utf-8", "surrogatepass")) > LONGEST_NAME:
        raise ValueError(f"its buffer has too long a name ({shortened(uri)})")
    folder = path.parent.resolve()
    file = (folder / name).resolve() if "://" not in uri else None
    if file is None or not file.is_relative_to(folder):
        raise ValueError(f"its buffer {shortened(uri)} does not lie in the folder of the file")
    if not is_regular(file):
        raise ValueError(f"its buffer {shortened(uri)} is missing")
    return file


def _split_glb(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a *.glb."""
    if len(data) < HEAD.size + CHUNK.size:
        raise ValueError("is cut off")
    _, version, total = HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"is a GLB of version {version}; this program reads version {VERSION}")
    if not HEAD.size + CHUNK.size <= total <= len(data):
        raise ValueError(f"is cut off: it has {len(data)} bytes where {total} are announced")
    chunks: dict[int, bytes] = {}
    place = HEAD.size
    while place + CHUNK.size <= total and len(chunks) < 2:
        length, kind = CHUNK.unpack_from(data, place)
        place += CHUNK.size
        if place + length > total:
            raise ValueError("is damaged: a chunk is longer than the file")
        chunks.setdefault(kind, data[place : place + length])
        place += length
    if JSON_CHUNK not in chunks:
        raise ValueError("is damaged: it has no JSON")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)


def _count(described: Mapping[str, Any], name: str, what: str, default: int | None = None) -> int:
    """Return a field that is a whole number, not negative."""
    value = described.get(name, default)
    if type(value) is not int or not 0 <= value < 1 << 53:
        raise ValueError(f"{what}: {name} must be a whole number; got {shortened(value)}")
    return value


def _fractions(values: np.ndarray) -> np.ndarray:
    """Return normalised integers as fractions."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    fractions = values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    within: np.ndarray = np.maximum(fractions, np.float32(-1.0))
    return within
