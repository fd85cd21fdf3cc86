"""SPZ files of versions 1 to 4, as Niantic's library has them (https://github.com/nianticlabs/spz).

After a header come columns of bytes: positions in fixed point of 24 bits, opacities, colours of degree 0, log-scales,
rotations, and spherical harmonics above degree 0, coefficient by coefficient. Versions 1 to 3 are one gzip stream.
Version 4 has a plain header, records of extensions, a table of lengths, and each column in zstd. Version 1 has
positions in float16, and versions 1 and 2 x, y and z of a rotation in a byte each; later ones have the three smaller
numbers in 10 bits, the sign first, after the index (xyzw) of the largest. Files are written as version 3, which most
programs read.

The record SPZ_ADOBE_coordinate_system names the directions of the axes. Files without it have, as most do, the axes of
the PLY they come from: right, down, front (docs/formats.md). Records of other kinds are skipped.

Every length is checked against the file before anything is unpacked.
"""

import dataclasses
import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from a2tg_jax import Gaussians, Model, Similarity, transform_gaussians
from a2tg_jax.base.regular_files import room_of
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.io.columns import unzstd
from a2tg_jax.io.other_programs import (
    Ellipsoids,
    PlacedSplats,
    degree_to_read,
    model_of_splats,
    pack_bits,
    to_bytes,
    unpack_bits,
    with_largest,
    without_largest,
)

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
HEAD = struct.Struct("<4sIIBBBB")
"""Magic, version, number of splats, degree, fractional bits, flags; a reserved byte, or the number of streams."""
LONG_HEAD_BYTES = 32
TABLE_PLACE = struct.Struct("<16xI")
"""Byte at which the table of lengths begins, in the header of version 4."""
LENGTHS = struct.Struct("<QQ")
"""Compressed and unpacked bytes of a stream."""
RECORD = struct.Struct("<II")
"""Type and length of an extension."""
HAS_EXTENSIONS = 2
COORDINATE_SYSTEM = 0xADBE0003
AXES = (
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip
"""Directions of x, y and z by their number in the record, from 1."""
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""Right, left, down, up, front and back in the axes of a PLY."""
PLY_AXES = "RDF"
GLTF_AXES = "RUB"
HIGHEST_DEGREE = 4
WRITTEN_VERSION = 3
FRACTIONAL_BITS = 12
ROTATION_BITS = (2, 1, 9, 1, 9, 1, 9)
"""Index of the largest number, then sign and magnitude of each of the others."""
COLOR_SCALE = 0.15
SH_STEPS = (8, 16)
"""Steps of 1/128 to which coefficients of degree 1, and of higher ones, are rounded, as Niantic's library does."""


# Reading


def decode_spz(data: bytes, path: Path, axes: str = PLY_AXES) -> Model:
    """Return the model of an SPZ file's bytes, in a world with these axes; messages name the path.

    A file that declares no axes is taken to have them. Ellipsoids become flat as in `load_ply`. Coefficients above
    degree 3 are left out, with a warning.

    Raises:
      ValueError: if the bytes are no SPZ, are damaged or cut off, or contradict themselves.
    """
    if data[:4] == MAGIC:
        head, columns, records = _columns_of_streams(data)
    elif data[:2] == GZIP_MAGIC:
        head, columns, records = _columns_of_gzip(data)
    else:
        raise ValueError("is not SPZ")
    degree = degree_to_read(head.degree, str(path))
    rows = {name: column.reshape(head.num, -1) for name, column in columns.items()}
    rest = (rows["sh"].reshape(head.num, -1, 3)[:, : NUM_BASES[degree] - 1].astype(np.float64) - 128) / 128
    colors = (rows["colors"] / 255 - 0.5) / COLOR_SCALE
    sh = np.concatenate([colors[:, None], rest], axis=1)
    scales = np.exp(rows["scales"] / 16 - 10)
    opacities = rows["opacities"][:, 0] / 255
    splats = Ellipsoids.of(_means(rows["positions"], head), _quats(rows["rotations"], head), scales, opacities, sh)
    model = model_of_splats(splats, path)
    declared = _declared_axes(records)
    return dataclasses.replace(model, gaussians=_turned(model.gaussians, declared or axes, axes))


def _means(rows: np.ndarray, head: "_Head") -> np.ndarray:
    if head.version == 1:
        return rows.view("<f2").astype(np.float64)
    # A sign bit in the highest of three bytes: shifted up, then down.
    low, middle, high = rows.reshape(head.num, 3, 3).astype(np.int32).transpose(2, 0, 1)
    fixed = ((low << 8) | (middle << 16) | (high << 24)) >> 8
    return fixed / 2.0**head.fractional_bits


def _quats(rows: np.ndarray, head: "_Head") -> np.ndarray:
    if head.version < 3:
        return with_largest(rows / 127.5 - 1, np.zeros(head.num, np.int64))  # w is the number that follows.
    largest, *fields = unpack_bits(rows.view("<u4")[:, 0], ROTATION_BITS)
    signs = np.stack(fields[::2], axis=1)
    magnitudes = np.stack(fields[1::2], axis=1)
    smaller = magnitudes / 511 * np.sqrt(0.5) * np.where(signs, -1.0, 1.0)
    return with_largest(smaller, largest)[:, [3, 0, 1, 2]]


class _Head(NamedTuple):
    version: int
    num: int
    degree: int
    fractional_bits: int
    flags: int
    num_streams: int

    @property
    def widths(self) -> Mapping[str, int]:
        """Bytes of a splat in each column."""
        return {
            "positions": 6 if self.version == 1 else 9, "opacities": 1, "colors": 3, "scales": 3,
            "rotations": 3 if self.version < 3 else 4, "sh": 3 * ((self.degree + 1) ** 2 - 1),
        }  # fmt: skip


def _head_of(data: bytes) -> _Head:
    if len(data) < HEAD.size:
        raise ValueError(f"is cut off: its header has {HEAD.size} bytes, the file {len(data)}")
    magic, *numbers = HEAD.unpack_from(data)
    head = _Head(*numbers)
    if magic != MAGIC or not 1 <= head.version <= 4:
        raise ValueError(f"is not SPZ of version 1 to 4; got {magic!r}, version {head.version}")
    if not head.num:
        raise ValueError("holds no splats")
    if head.degree > HIGHEST_DEGREE or head.fractional_bits > 24:
        raise ValueError(
            f"is damaged: its header has degree {head.degree} and {head.fractional_bits} fractional bits; up to "
            f"{HIGHEST_DEGREE} and 24 are possible"
        )
    return head


def _columns_of_gzip(data: bytes) -> tuple[_Head, dict[str, np.ndarray], bytes]:
    """Return header, columns and extensions of versions 1 to 3."""
    stream = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        unpacked = stream.decompress(data, room_of(len(data)))
    except zlib.error as error:
        raise ValueError(f"is damaged: its gzip stream cannot be unpacked ({error})") from error
    if stream.unconsumed_tail:
        raise ValueError("unpacks to more than 64 times its size")
    if not stream.eof:
        raise ValueError("is cut off: its gzip stream has no end")
    head = _head_of(unpacked)
    if head.version > 3:
        raise ValueError(f"is damaged: SPZ of version {head.version} is no gzip stream")
    end = HEAD.size + head.num * sum(head.widths.values())
    if end > len(unpacked):
        raise ValueError(f"is cut off: {head.num:,} splats need {end:,} bytes, and {len(unpacked):,} are there")
    columns = {}
    place = HEAD.size
    for name, width in head.widths.items():
        columns[name] = np.frombuffer(unpacked, np.uint8, head.num * width, place)
        place += head.num * width
    return head, columns, unpacked[end:] if head.flags & HAS_EXTENSIONS else b""


def _columns_of_streams(data: bytes) -> tuple[_Head, dict[str, np.ndarray], bytes]:
    """Return header, columns and extensions of version 4."""
    head = _head_of(data)
    if head.version < 4 or len(data) < LONG_HEAD_BYTES:
        raise ValueError(f"is damaged: SPZ of version {head.version} with {len(data):,} bytes has no plain header")
    (table,) = TABLE_PLACE.unpack_from(data)
    widths = {name: width for name, width in head.widths.items() if width}
    place = table + LENGTHS.size * len(widths)
    if head.num_streams != len(widths) or table < LONG_HEAD_BYTES or place > len(data):
        raise ValueError(
            f"is damaged: it has {head.num_streams} streams, where degree {head.degree} has {len(widths)}, and their "
            f"table at byte {table:,} of {len(data):,}"
        )
    if head.num * sum(head.widths.values()) > room_of(len(data)):
        raise ValueError(f"claims {head.num:,} splats, more than a file of {len(data):,} bytes may unpack to")
    columns = {"sh": np.zeros(0, np.uint8)}
    for index, (name, width) in enumerate(widths.items()):
        packed, unpacked = LENGTHS.unpack_from(data, table + LENGTHS.size * index)
        if unpacked != head.num * width or packed > len(data) - place:
            raise ValueError(
                f"is damaged or cut off: {packed:,} bytes of {name} at byte {place:,} unpack to {unpacked:,}, where "
                f"{head.num:,} splats have {head.num * width:,}"
            )
        try:
            columns[name] = np.frombuffer(unzstd(data[place : place + packed], unpacked), np.uint8)
        except ValueError as error:
            raise ValueError(f"is damaged: {name} cannot be unpacked ({error})") from error
        place += packed
    return head, columns, data[LONG_HEAD_BYTES:table] if head.flags & HAS_EXTENSIONS else b""


def _declared_axes(records: bytes) -> str:
    """Return the axes that the extensions of a file declare; "" if they declare none."""
    axes = ""
    place = 0
    while place + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, place)
        place += RECORD.size
        if length > len(records) - place:
            raise ValueError(f"is damaged: an extension has {length:,} bytes, and {len(records) - place:,} are there")
        if kind == COORDINATE_SYSTEM:
            number = int.from_bytes(records[place : place + length], "little")
            if length != 4 or number > len(AXES):
                raise ValueError(f"declares axes by number {number}; 1 to {len(AXES)} are known")
            # 0 is "unspecified".
            axes = AXES[number - 1] if number else ""
        place += length
    return axes


def _turned(gaussians: Gaussians, axes: str, wanted: str) -> Gaussians:
    """Return Gaussians with these axes in a world with the axes `wanted`."""
    if axes == wanted:
        return gaussians
    directions = np.array([DIRECTIONS[letter] for letter in axes], np.float64)
    wanted_directions = np.array([DIRECTIONS[letter] for letter in wanted], np.float64)
    # Columns of the transpose are the directions of the file's axes.
    matrix = wanted_directions @ directions.T
    if np.linalg.det(matrix) < 0:
        # Left-handed axes: z → −z first. A Gaussian's rotation R becomes M·R·M, and Y_lm changes by (−1)^(l + m).
        flip = np.array([1.0, 1.0, -1.0])
        signs = [(-1.0) ** (degree + order) for degree in range(4) for order in range(-degree, degree + 1)]
        sh = np.asarray(gaussians.sh)
        gaussians = dataclasses.replace(
            gaussians,
            means=jnp.asarray(np.asarray(gaussians.means) * flip, jnp.float32),
            quats=jnp.asarray(np.asarray(gaussians.quats) * [1.0, -1.0, -1.0, 1.0], jnp.float32),
            sh=jnp.asarray(sh * np.array(signs)[: sh.shape[1], None], jnp.float32),
        )
        matrix = matrix * flip
    return transform_gaussians(gaussians, Similarity(1.0, matrix, np.zeros(3)))


# Writing


def encode_spz(placed: PlacedSplats) -> bytes:
    """Return splats as an SPZ file, always the same for the same splats."""
    splats = placed.splats
    num = len(splats.means)
    degree = NUM_BASES.index(splats.sh.shape[1])
    fixed = np.rint(splats.means.astype(np.float64) * 2**FRACTIONAL_BITS).astype("<i4")
    largest, smaller = without_largest(splats.quats[:, [1, 2, 3, 0]].astype(np.float64))
    magnitudes = np.rint(np.abs(smaller) * np.sqrt(2) * 511)
    fields = np.stack([smaller < 0, magnitudes], axis=2).reshape(num, 6)
    rotations = pack_bits([largest, *fields.T], ROTATION_BITS)
    rest = np.rint(splats.sh[:, 1:] * 128).astype(np.int64) + 128
    steps = np.where(np.arange(rest.shape[1]) < 3, *SH_STEPS)[:, None]
    columns = (
        fixed.view(np.uint8).reshape(num, 3, 4)[..., :3],
        to_bytes(255 * splats.opacities),
        to_bytes(255 * (COLOR_SCALE * splats.sh[:, 0] + 0.5)),
        to_bytes(16 * (np.log(splats.scales) + 10)),
        rotations,
        to_bytes((rest + steps // 2) // steps * steps),
    )
    head = HEAD.pack(MAGIC, WRITTEN_VERSION, num, degree, FRACTIONAL_BITS, 0, 0)
    return gzip.compress(head + b"".join(column.tobytes() for column in columns), mtime=0)
