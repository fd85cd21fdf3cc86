"""Writes glTF 2.0: arrays as accessors of one buffer, in one *.glb or a *.gltf with a *.bin beside it."""

import json
import struct
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.host.atomic import replacing

MAGIC, VERSION = b"glTF", 2
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
HEAD, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
MOST_GLB_BYTES = 2**32 - 1
ARRAY_BUFFER = 34962
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Types of numbers, by their code."""
SIDES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


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
        """Add numbers [n] or [n, 2 to 4] of a type of glTF, and return the index of their accessor.

        Args:
          values: the numbers, at least one row.
          normalized: integers stand for numbers in [0, 1] or [-1, 1].
          has_bounds: the accessor says the smallest and the largest of each column.
          is_attribute: they are an attribute of a mesh.
        """
        columns = values.reshape(len(values), -1)
        code = next(code for code, name in COMPONENTS.items() if np.dtype(name) == values.dtype.newbyteorder("<"))
        accessor: dict[str, Any] = {"bufferView": len(self._views), "componentType": code, "count": len(values)}
        accessor["type"] = next(name for name, sides in SIDES.items() if sides == columns.shape[1])
        if normalized:
            accessor["normalized"] = True
        if has_bounds:
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        data = np.ascontiguousarray(columns, np.dtype(COMPONENTS[code])).tobytes()
        self.add_bytes(data, **({"target": ARRAY_BUFFER} if is_attribute else {}))
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes, **options: Any) -> int:
        """Add bytes, such as an image, and return the index of their buffer view, which has these options."""
        self._views.append({"buffer": 0, "byteOffset": self._num_bytes, "byteLength": len(data), **options})
        self._pieces.append(data + bytes(-len(data) % 4))
        self._num_bytes += len(self._pieces[-1])
        return len(self._views) - 1

    def save(self, path: Path, described: Mapping[str, Any]) -> None:
        """Write the file, *.gltf with a *.bin beside it, any other name as one *.glb.

        Args:
          path: the file; an older one is replaced once the new one is whole.
          described: the JSON without accessors and buffers.

        Raises:
          ValueError: if one file cannot hold so many bytes.
        """
        buffer: dict[str, Any] = {"byteLength": self._num_bytes}
        stored = {"accessors": self.accessors, "bufferViews": self._views, "buffers": [buffer]}
        whole = {**described, **stored}
        if path.suffix.lower() != ".gltf":
            return _write_glb(path, whole, self._pieces)
        binary = path.with_suffix(".bin")
        buffer["uri"] = urllib.parse.quote(binary.name)
        with replacing(binary) as temporary, open(temporary, "wb") as file:
            file.writelines(self._pieces)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(whole, allow_nan=False, indent=1), encoding="utf-8")


def _write_glb(path: Path, whole: Mapping[str, Any], pieces: Sequence[bytes]) -> None:
    text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    num_bytes = sum(map(len, pieces))
    total = HEAD.size + CHUNK.size + len(text) + CHUNK.size + num_bytes
    if total > MOST_GLB_BYTES:
        raise ValueError(f"{path}: a *.glb holds up to {MOST_GLB_BYTES:,} bytes, but these are {total:,}; write *.gltf")
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(HEAD.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON_CHUNK) + text)
        file.write(CHUNK.pack(num_bytes, BINARY_CHUNK))
        file.writelines(pieces)
