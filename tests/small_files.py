"""Compact scenes and archives as bytes, taken apart and put together by their published formats alone."""

import dataclasses
import json
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np

from a2tg_jax import CompactChoices, Model, load_compact, save_compact

HEAD = struct.Struct("<8sHIII")
"""Magic, version, header bytes as coded and as text, checksum of all that follows."""
MAGIC = b"a2tgz\r\n\x1a"
GROUPS = tuple(field.name for field in dataclasses.fields(CompactChoices) if field.name != "coder")
EXACT = CompactChoices(**dict.fromkeys(GROUPS, "float32"))
DEFAULT = CompactChoices()
SCALES = ("scale_0", "scale_1")
ATTRIBUTES = (
    "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity",
    *SCALES, *(f"rot_{i}" for i in range(4)),
)  # fmt: skip
"""Columns of splats in PLY."""


def compact_bytes(model: Model, choices: CompactChoices = DEFAULT, grids=None) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.a2tgz"
        save_compact(path, model, choices=choices, grids=grids)
        return path.read_bytes()


def model_in(data: bytes) -> Model:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.a2tgz"
        path.write_bytes(data)
        return load_compact(path)


def taken_apart(data: bytes) -> tuple[dict, bytes]:
    """The header and the body of a compact scene."""
    _, _, num_coded, _, _ = HEAD.unpack_from(data)
    rest = data[HEAD.size :]
    return json.loads(zlib.decompress(rest[:num_coded])), rest[num_coded:]


def put_together(header: dict, body: bytes = b"") -> bytes:
    return with_header_text(json.dumps(header).encode(), body)


def with_header_text(text: bytes, body: bytes = b"", num_text: int | None = None) -> bytes:
    """A compact scene whose header is this text, of so many bytes as it says."""
    coded = zlib.compress(text)
    rest = coded + body
    num_text = len(text) if num_text is None else num_text
    return HEAD.pack(MAGIC, 3, len(coded), num_text, zlib.crc32(rest)) + rest


def half_turned(model: Model) -> Model:
    """The model as its file without rounding has it."""
    return model_in(compact_bytes(model, EXACT))


def grids_of(model: Model, choices: CompactChoices) -> dict[str, tuple[float, ...]]:
    """First and last steps of the groups in bits, as a file names them."""
    header, _ = taken_apart(compact_bytes(model, dataclasses.replace(choices, coder="none")))
    return {name: tuple(ends) for name, ends in header["ends"].items()}


def read_archive(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """The header and the arrays of a model or a checkpoint."""
    with np.load(path) as archive:
        arrays = dict(archive)
    return json.loads(arrays.pop("header").tobytes()), arrays


def write_archive(path: Path, header: dict, arrays: dict[str, np.ndarray]) -> None:
    with open(path, "wb") as file:
        np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
