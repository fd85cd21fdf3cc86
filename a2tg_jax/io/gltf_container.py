"""glTF 2.0 as a container of numbers: a builder of files, and a reader of untrusted files.

A file is one *.glb, or a *.gltf with buffers in further files or embedded. Reading takes no more memory than a file
justifies.
"""

import base64
import binascii
import json
import math
import struct
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.base.atomic import replacing, write_whole
from a2tg_jax.base.checks import check_int
from a2tg_jax.base.json_text import number_array, parse_json
from a2tg_jax.base.regular_files import (
    LARGEST_RATIO,
    MOST_ARRAY_BYTES,
    existing_bytes,
    is_regular,
    read_regular,
    room_of,
)
from a2tg_jax.base.text import PROGRAM, shortened
from a2tg_jax.data.ply import turn_of

MAGIC = b"glTF"
VERSION = 2
JSON_CHUNK = 0x4E4F534A  # "JSON", little-endian.
BINARY_CHUNK = 0x004E4942  # "BIN\0".
HEAD = struct.Struct("<4sII")
CHUNK = struct.Struct("<II")
MOST_COUNT = 1 << 53  # JSON's numbers are exact up to this.
MOST_GLB_BYTES = 2**32 - 1  # The header has the length as uint32.
ARRAY_BUFFER = 34962  # OpenGL's number for vertex data.
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Types of numbers, by their code."""
SIDES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MOST_STRIDE = 252  # glTF 2.0, bufferView.byteStride.
LONGEST_NAME = 255
"""Largest number of bytes in a buffer's name."""


# Writing


class Builder:
    """Arrays as accessors of one buffer."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._pieces: list[bytes] = []
        self._num_bytes = 0

    def add(
        self, values: np.ndarray, *, normalized: bool = False, has_bounds: bool = False, is_attribute: bool = True
    ) -> int:
        """Add numbers [n] or [n, 2 to 4] of a glTF type, and return the index of their accessor.

        Args:
          values: the numbers, at least one row.
          normalized: integers encode numbers in [0, 1] or [-1, 1].
          has_bounds: the accessor has the minimum and the maximum of each column.
          is_attribute: the numbers are an attribute of a mesh.
        """
        columns = values.reshape(len(values), -1)
        dtype = values.dtype.newbyteorder("<")
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": next(code for code, name in COMPONENTS.items() if np.dtype(name) == dtype),
            "count": len(values),
            "type": next(name for name, num in SIDES.items() if num == columns.shape[1]),
        }
        if normalized:
            accessor["normalized"] = True
        if has_bounds:
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        # glTF is little-endian.
        data = np.ascontiguousarray(columns, dtype).tobytes()
        self.add_bytes(data, **({"target": ARRAY_BUFFER} if is_attribute else {}))
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes, **options: object) -> int:
        """Add bytes, such as an image, and return the index of their buffer view with these options."""
        self._views.append({"buffer": 0, "byteOffset": self._num_bytes, "byteLength": len(data), **options})
        # glTF aligns accessors to their component size, at most 4 bytes.
        self._pieces.append(data + bytes(-len(data) % 4))
        self._num_bytes += len(self._pieces[-1])
        return len(self._views) - 1

    def save(self, path: Path, described: Mapping[str, object]) -> None:
        """Write the file, *.gltf with a *.bin, any other name as one *.glb.

        Existing files are replaced once the new ones are complete. `described` is the JSON minus asset, accessors and
        buffers.

        Raises:
          ValueError: if a *.glb cannot hold this many bytes.
        """
        buffer: dict[str, Any] = {"byteLength": self._num_bytes}
        whole = {
            "asset": {"version": "2.0", "generator": PROGRAM},
            **described,
            "accessors": self.accessors,
            "bufferViews": self._views,
            "buffers": [buffer],
        }
        if path.suffix.lower() == ".gltf":
            binary = path.with_suffix(".bin")
            buffer["uri"] = urllib.parse.quote(binary.name)
            # The buffer first: a *.gltf never names one that is not there yet.
            with replacing(binary) as temporary, open(temporary, "wb") as file:
                file.writelines(self._pieces)
            write_whole(path, json.dumps(whole, allow_nan=False, indent=1))
            return
        text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
        # Chunks of a GLB are aligned to 4 bytes; JSON is padded with spaces.
        text += b" " * (-len(text) % 4)
        total = HEAD.size + CHUNK.size + len(text) + CHUNK.size + self._num_bytes
        if total > MOST_GLB_BYTES:
            most = f"{MOST_GLB_BYTES:,} bytes, but these are {total:,}"
            raise ValueError(f"{path}: a *.glb holds up to {most}; write *.gltf")
        start = HEAD.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON_CHUNK)
        with replacing(path) as temporary, open(temporary, "wb") as file:
            file.write(start + text + CHUNK.pack(self._num_bytes, BINARY_CHUNK))
            file.writelines(self._pieces)


def scene_of_one(node: Mapping[str, object], primitive: Mapping[str, object]) -> dict[str, Any]:
    """Return the JSON of a scene of one node, whose mesh 0 has one primitive."""
    return {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
    }


# Reading


class Document:
    """A file's JSON, and the numbers of its accessors. FileNotFoundError: there is no such file. ValueError: it is not
    glTF 2.0, or is damaged."""

    def __init__(self, path: Path):
        self.path = path
        data = existing_bytes(path, "glTF file")
        self._binary: bytes | None = None
        text = data
        if data[:4] == MAGIC:
            text, self._binary = _split_glb(data)
        try:
            self.json = parse_json(text)
        except ValueError as error:
            raise ValueError(f"is not glTF, or is damaged: {error}") from error
        if not isinstance(self.json, dict) or not isinstance(self.json.get("asset"), dict):
            raise ValueError("is not glTF")
        version = self.json["asset"].get("version")
        if version != "2.0":
            raise ValueError(f"is glTF of version {shortened(version)}; this program reads 2.0")
        self._buffers: dict[int, bytes] = {}
        self._files: dict[Path, bytes] = {}
        self._room = room_of(len(data))  # For its numbers as float32.

    def entry(self, kind: str, index: object) -> dict[str, Any]:
        """Return an object of one of the file's lists, such as "nodes"."""
        entries = self.json.get(kind, [])
        if type(index) is not int or not isinstance(entries, list) or not 0 <= index < len(entries):
            raise ValueError(f"has no {kind}[{shortened(index)}]")
        if not isinstance(entries[index], dict):
            raise ValueError(f"its {kind}[{index}] is not an object")
        return entries[index]

    def numbers(self, index: object, kind: str, what: str) -> np.ndarray:
        """Return the numbers of an accessor as float32 [n, columns]; normalised integers become fractions.
        ValueError, naming it `what`: it is missing, of another kind, or exceeds its buffer."""
        accessor = self.entry("accessors", index)
        if accessor.get("type") != kind or accessor.get("componentType") not in COMPONENTS:
            actual = f"{accessor.get('type')} of {accessor.get('componentType')}"
            raise ValueError(f"{what} must be {kind} of numbers; got {shortened(actual)}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"{what} is a sparse accessor, which this program does not read")
        dtype = np.dtype(COMPONENTS[accessor["componentType"]])
        shape = (_count(accessor, "count", what), SIDES[kind])
        size = dtype.itemsize * SIDES[kind]
        data = self.view(accessor["bufferView"], what)
        stride = _count(self.entry("bufferViews", accessor["bufferView"]), "byteStride", what, size)
        if stride < size or stride > max(size, MOST_STRIDE):
            raise ValueError(f"{what} has a stride of {stride} bytes for {size}")
        first = _count(accessor, "byteOffset", what, 0)
        if shape[0] and first + stride * (shape[0] - 1) + size > len(data):
            raise ValueError(f"{what} has {shape[0]} entries, but its buffer is too short for them")
        # Several accessors may share bytes, but each one's numbers take memory.
        num_bytes = 4 * math.prod(shape)
        if num_bytes > self._room:
            raise ValueError(f"{what} would take {num_bytes} bytes, which the file is too small for")
        self._room -= num_bytes
        rows = np.ndarray(shape, dtype, data, first, (stride, dtype.itemsize)) if shape[0] else np.zeros(shape, dtype)
        values = rows.astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind != "f":
            # glTF: max(c / 127, −1) for signed bytes, since −128 would be below −1.
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return values

    def view(self, index: object, what: str) -> memoryview:
        """Return the bytes of a buffer view. ValueError, naming it `what`: it is missing, or exceeds its buffer."""
        view = self.entry("bufferViews", index)
        data = self._buffer(view.get("buffer"), what)
        start = _count(view, "byteOffset", what, 0)
        # Python's integers do not overflow, so sums of claimed numbers are safe to compare.
        end = start + _count(view, "byteLength", what)
        if end > len(data):
            raise ValueError(f"{what} reaches beyond its buffer of {len(data)} bytes")
        return memoryview(data)[start:end]

    def _buffer(self, index: Any, what: str) -> bytes:
        """Return the bytes of a buffer; each is read once."""
        described = self.entry("buffers", index)
        length = _count(described, "byteLength", what)
        if index not in self._buffers:
            uri = described.get("uri")
            if uri is not None:
                self._buffers[index] = self._read(uri)
            # Only the first buffer may be the GLB's binary chunk.
            elif index == 0 and self._binary is not None:
                self._buffers[index] = self._binary
            else:
                raise ValueError(f"has no bytes for buffers[{index}]")
        data = self._buffers[index]
        if len(data) < length:
            raise ValueError(f"is cut off: its buffer has {len(data)} bytes where {length} are announced")
        return data

    def _read(self, uri: Any) -> bytes:
        """Return the bytes of a buffer that is a file in the same folder, or embedded in the JSON."""
        if not isinstance(uri, str):
            raise ValueError("the uri of a buffer is not text")
        if uri.startswith("data:"):
            _, mark, text = uri.partition(";base64,")
            if not mark:
                raise ValueError("its embedded buffer is not base64, as glTF 2.0 has it; export it again")
            try:
                return base64.b64decode(text, validate=True)
            except binascii.Error as error:
                raise ValueError(f"its embedded buffer is damaged ({error})") from error
        file = _named_file(self.path, uri)
        if file not in self._files:
            self._files[file] = read_regular(file, MOST_ARRAY_BYTES)
            self._room += LARGEST_RATIO * len(self._files[file])
        return self._files[file]


def buffer_files(path: Path) -> list[Path]:
    """Return the files that the buffers of a *.gltf name; none if it cannot be read."""
    try:
        uris = [buffer.get("uri", "data:") for buffer in Document(path).json["buffers"]]
        return list(dict.fromkeys(_named_file(path, uri) for uri in uris if not uri.startswith("data:")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def _named_file(path: Path, uri: str) -> Path:
    """Return the file of a buffer. Raises ValueError if it is missing or outside the glTF's folder."""
    name = urllib.parse.unquote(uri, errors="strict")
    if len(name.encode("utf-8", "surrogatepass")) > LONGEST_NAME:
        raise ValueError(f"its buffer has too long a name ({shortened(uri)})")
    # Links are resolved first, so that none leads out of the folder.
    folder = path.parent.resolve()
    file = (folder / name).resolve() if "://" not in uri else None
    if file is None or not file.is_relative_to(folder):
        raise ValueError(f"its buffer {shortened(uri)} is not in the folder of the file")
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
    # glTF has the two known chunks first; extensions may append others.
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


def _count(described: Mapping[str, object], name: str, what: str, default: int | None = None) -> int:
    """Return a field that is a non-negative integer."""
    value: Any = described.get(name, default)
    check_int(f"{what}: {name}", value, 0, MOST_COUNT)
    return int(value)


# Nodes


def mesh_nodes(document: Document) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the nodes of the scene that have a mesh, and the matrix [4, 4] from each to the world.

    Without scenes, all nodes are in the scene.

    Raises:
      ValueError: if a node is missing or occurs twice, or its transform is not numeric.
    """
    if document.json.get("scenes"):
        roots = _indices(document.entry("scenes", document.json.get("scene", 0)), "nodes")
    else:
        nodes = document.json.get("nodes", [])
        children = {child for node in nodes for child in _indices(node, "children")}
        # Without a scene, a node is a root if no other has it as a child.
        roots = [index for index in range(len(nodes)) if index not in children]
    seen: set[int] = set()
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    while waiting:  # No recursion: a file may nest nodes deeper than Python's call stack.
        index, parent = waiting.pop()
        node = document.entry("nodes", index)
        # Nodes are a forest in glTF; a cycle would never end.
        if index in seen:
            raise ValueError(f"its nodes[{index}] occurs twice")
        seen.add(index)
        # Chains of large scales overflow; `similarity_of` rejects what is not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ _local_matrix(node)
        if "mesh" in node:
            yield node, matrix
        waiting += [(child, matrix) for child in reversed(_indices(node, "children"))]


def _indices(described: Mapping[str, object], name: str) -> list[Any]:
    indices = described.get(name, [])
    if not isinstance(indices, list):
        raise ValueError(f"{name} must be a list; got {shortened(indices)}")
    return indices


def _local_matrix(node: Mapping[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] from a node to its parent, for columns."""

    def vector(name: str, default: list[float]) -> np.ndarray:
        return number_array(node.get(name, default), len(default), f"{name} of a node")

    if "matrix" in node:
        # Column by column in the file.
        return vector("matrix", [0.0] * 16).reshape(4, 4).T
    xyzw = vector("rotation", [0.0, 0.0, 0.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = turn_of(xyzw[[3, 0, 1, 2]]) * vector("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = vector("translation", [0.0, 0.0, 0.0])
    return matrix
