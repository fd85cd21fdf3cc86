"""Splat files with rows of fixed size: *.splat and *.ksplat.

A row of a *.splat is position and scales in float32, colour and opacity in a byte each, and a rotation (wxyz) in bytes,
of which 128 is 0.

A *.ksplat of GaussianSplats3D, version 0.1, is a header of 4096 bytes, then one of 1024 for each section, then the
sections. Splats are rows of fixed size: position, scales, rotation (wxyz), colour of degree 0 and opacity in a byte
each, and spherical harmonics, degree by degree and within each channel by channel. Compression level 0 has floats.
Level 1 has halves, and positions as 16 bits around the centre of a bucket; level 2 is level 1 with spherical harmonics
in bytes. A section of level 1 or 2 begins with the lengths of its partially filled buckets and the centres of all
buckets. Its splats are in bucket order, full buckets first. Files are written at level 0, up to degree 2, the most that
GaussianSplats3D reads.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from a2tg_jax import Model
from a2tg_jax.core.sh import NUM_BASES, SH_C0
from a2tg_jax.io.other_programs import LEAST_SCALE, Ellipsoids, PlacedSplats, model_of_splats, to_bytes

# .splat

SPLAT_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def encode_splat(placed: PlacedSplats) -> bytes:
    """Return splats as a *.splat, without spherical harmonics above degree 0."""
    splats = placed.splats
    rows = np.zeros(len(splats.means), SPLAT_ROW)
    rows["means"] = splats.means
    rows["scales"] = splats.scales
    rows["colors"] = _color_bytes(splats)
    rows["quats"] = to_bytes(128 * splats.quats + 128)
    return rows.tobytes()


def decode_splat(data: bytes, path: Path) -> Model:
    """Return the model of a file's bytes, in the world of the file. Messages name the path; ellipsoids become flat, as
    in `load_ply`. ValueError: the file is cut off, empty, or has no finite splat."""
    if not data or len(data) % SPLAT_ROW.itemsize:
        raise ValueError(
            f"is not a .splat file, or is cut off: it has {len(data):,} bytes, and a splat has {SPLAT_ROW.itemsize}"
        )
    rows = np.frombuffer(data, SPLAT_ROW)
    sh, opacities = _shown_by(rows["colors"])
    quats = (rows["quats"].astype(np.float64) - 128) / 128
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), LEAST_SCALE)  # Rounded to bytes.
    return model_of_splats(Ellipsoids.of(rows["means"], quats, rows["scales"], opacities, sh), path)


def _color_bytes(splats: Ellipsoids) -> np.ndarray:
    """Return colours of degree 0 and opacities [N, 4] as bytes."""
    colors = np.concatenate([0.5 + SH_C0 * splats.sh[:, 0], splats.opacities[:, None]], axis=1)
    return to_bytes(255 * colors)


def _shown_by(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the spherical harmonics [N, 1, 3] and the opacities [N] of colours [N, 4] in bytes."""
    shares = colors / 255
    return (shares[:, None, :3] - 0.5) / SH_C0, shares[:, 3]


# .ksplat

HEADER_BYTES = 4096
SECTION_BYTES = 1024
KSPLAT_HEADER = struct.Struct("<2B2x4IH2x5f")
"""Version, largest and present number of sections, of splats, level, centre of the scene, least and largest number of
the spherical harmonics of level 2."""
KSPLAT_SECTION = struct.Struct("<4IfH2x4IH")
KSPLAT_VERSION = (0, 1)
BUCKET_BYTES = 12
DEFAULT_RANGE = 32767
DEFAULT_ENDS = (-1.5, 1.5)
KSPLAT_DEGREE = 2


class _Section(NamedTuple):
    """Header of a section."""

    num: int
    """Present number of splats."""
    most: int
    """Largest number of splats, for which there is room."""
    bucket_size: int
    num_buckets: int
    side: float
    """Side of a bucket."""
    centre_bytes: int
    """Bytes of a bucket's centre."""
    reach: int
    """Largest code of a position, on either side of the centre."""
    num_bytes: int
    num_full: int
    """Number of full buckets."""
    num_partial: int
    """Number of partially filled buckets."""
    degree: int
    """Degree of the spherical harmonics."""


def encode_ksplat(placed: PlacedSplats) -> bytes:
    """Return splats as a *.ksplat of compression level 0, with degrees up to 2."""
    splats = placed.splats
    num = len(splats.means)
    degree = min(NUM_BASES.index(splats.sh.shape[1]), KSPLAT_DEGREE)
    rows = np.zeros(num, _ksplat_rows(0, degree))
    rows["means"] = splats.means
    rows["scales"] = splats.scales
    rows["quats"] = splats.quats
    rows["colors"] = _color_bytes(splats)
    bands = [splats.sh[:, band**2 : (band + 1) ** 2] for band in range(1, degree + 1)]
    if bands:
        # Degree by degree, and channel by channel within each.
        rows["rest"] = np.concatenate([band.transpose(0, 2, 1).reshape(num, -1) for band in bands], axis=1)
    counts = (1, 1, num, num, 0)
    header = KSPLAT_HEADER.pack(*KSPLAT_VERSION, *counts, 0.0, 0.0, 0.0, *DEFAULT_ENDS).ljust(HEADER_BYTES, b"\0")
    section = KSPLAT_SECTION.pack(num, num, 0, 0, 0.0, 0, 0, rows.nbytes, 0, 0, degree).ljust(SECTION_BYTES, b"\0")
    return header + section + rows.tobytes()


def decode_ksplat(data: bytes, path: Path) -> Model:
    """Return the model of a file's bytes of any compression level; as `decode_splat`."""
    if len(data) < HEADER_BYTES:
        raise ValueError(
            f"is not a .ksplat file, or is cut off: its header has {HEADER_BYTES} bytes, the file {len(data)}"
        )
    major, minor, num_sections, _, _, _, level, *_, low, high = KSPLAT_HEADER.unpack_from(data)
    if (major, minor) != KSPLAT_VERSION or level > 2:
        raise ValueError(
            f"is not a .ksplat file of version 0.1 and compression level 0 to 2; got {major}.{minor}, level {level}"
        )
    start = HEADER_BYTES + num_sections * SECTION_BYTES
    if start > len(data):
        raise ValueError(f"is cut off: {num_sections} sections were announced")
    # 0 stands for the default in GaussianSplats3D.
    ends = (low or DEFAULT_ENDS[0], high or DEFAULT_ENDS[1])
    parts: list[Ellipsoids] = []
    with np.errstate(over="ignore", invalid="ignore"):  # Rows that are not finite are left out later.
        for index in range(num_sections):
            section = _Section(*KSPLAT_SECTION.unpack_from(data, HEADER_BYTES + index * SECTION_BYTES))
            splats, start = _ksplat_section(data, start, section, level, ends)
            parts.append(splats)
    if not sum(len(splats.means) for splats in parts):
        raise ValueError("holds no splats")
    # Sections may differ in degree: lower ones are padded with zeros.
    num_bases = max(splats.sh.shape[1] for splats in parts)
    for index, splats in enumerate(parts):
        missing = num_bases - splats.sh.shape[1]
        parts[index] = splats._replace(sh=np.pad(splats.sh, ((0, 0), (0, missing), (0, 0))))
    return model_of_splats(Ellipsoids(*map(np.concatenate, zip(*parts, strict=True))), path)


def _ksplat_section(
    data: bytes, start: int, section: _Section, level: int, ends: tuple[float, float]
) -> tuple[Ellipsoids, int]:
    """Return the splats of a section that begins at a byte, and the byte after it."""
    num = section.num
    num_buckets = section.num_buckets
    degree = section.degree
    if degree >= len(NUM_BASES) or num > section.most or section.num_full + section.num_partial != num_buckets:
        raise ValueError(
            f"is damaged: a section has {num} of {section.most} splats of degree {degree}, and {section.num_full} full "
            f"and {section.num_partial} other buckets of {num_buckets}"
        )
    if num_buckets and section.centre_bytes != BUCKET_BYTES:
        raise ValueError(
            f"is damaged: a section has bucket centres of {section.centre_bytes} bytes, not {BUCKET_BYTES}"
        )
    dtype = _ksplat_rows(level, degree)
    centres_start = start + 4 * section.num_partial
    first = centres_start + BUCKET_BYTES * num_buckets
    # A section reserves room for its largest number of splats, not for those that it has.
    stop = first + section.most * dtype.itemsize
    if stop > len(data):
        raise ValueError(f"is cut off: a section ends at byte {stop:,} of {len(data):,}")
    rows = np.frombuffer(data, dtype, num, first)
    means = rows["means"].astype(np.float64)
    rest = np.asarray(rows["rest"], np.float64)
    if level:
        partial = np.frombuffer(data, "<u4", section.num_partial, start).astype(np.int64)
        bounds = np.cumsum(np.concatenate([np.full(section.num_full, section.bucket_size, np.int64), partial]))
        if num > bounds.max(initial=0):
            raise ValueError(f"is damaged: the buckets of a section have fewer than its {num} splats")
        centres = np.frombuffer(data, "<f4", 3 * num_buckets, centres_start).reshape(-1, 3)
        reach = section.reach or DEFAULT_RANGE
        # side right: splat i is in the first bucket that ends beyond i.
        bucket = np.searchsorted(bounds, np.arange(num), side="right")
        # Codes 0 to 2·reach are −side/2 to side/2 around the bucket's centre.
        means = (means - reach) * (section.side / 2 / reach) + centres[bucket]
    if level == 2:
        rest = ends[0] + rest / 255 * (ends[1] - ends[0])
    color, opacities = _shown_by(rows["colors"])
    sh = np.zeros((num, NUM_BASES[degree], 3))
    sh[:, :1] = color
    for band in range(1, degree + 1):
        low = band**2
        high = (band + 1) ** 2
        sh[:, low:high] = rest[:, 3 * (low - 1) : 3 * (high - 1)].reshape(num, 3, high - low).transpose(0, 2, 1)
    return Ellipsoids.of(means, rows["quats"], rows["scales"], opacities, sh), stop


def _ksplat_rows(level: int, degree: int) -> np.dtype:
    """Return the bytes of one splat."""
    mean = ("<f4", "<u2", "<u2")[level]
    number = ("<f4", "<f2", "<f2")[level]
    rest = ("<f4", "<f2", "u1")[level]
    return np.dtype(
        [
            ("means", mean, 3), ("scales", number, 3), ("quats", number, 4), ("colors", "u1", 4),
            ("rest", rest, (3 * (NUM_BASES[degree] - 1),)),
        ]
    )  # fmt: skip
