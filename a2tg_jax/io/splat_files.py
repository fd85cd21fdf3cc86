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

import os
import struct
from typing import Any

import numpy as np

from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.io import other_programs as others
from a2tg_jax.io.validate import existing_bytes, reading
from a2tg_jax.model import Model

# .splat

SPLAT_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def encode_splat(placed: others.PlacedSplats) -> bytes:
    """Return splats as a *.splat, without spherical harmonics above degree 0."""
    splats = placed.splats
    rows = np.zeros(len(splats.means), SPLAT_ROW)
    rows["means"] = splats.means
    rows["scales"] = splats.scales
    rows["colors"] = _color_bytes(splats)
    rows["quats"] = np.rint(np.clip(128 * splats.quats + 128, 0, 255))
    return rows.tobytes()


def load_splat(path: str | os.PathLike[str]) -> Model:
    """Read Gaussians, in the world of the file. Ellipsoids are flattened as in `load_ply`.
    FileNotFoundError: there is no such file. ValueError: it is cut off, empty, or has no finite splat."""
    data = existing_bytes(path, "file")
    with reading(path):
        if not data or len(data) % SPLAT_ROW.itemsize:
            raise ValueError(
                f"is not a .splat file, or is cut off: it has {len(data):,} bytes, and a splat has {SPLAT_ROW.itemsize}"
            )
        rows = np.frombuffer(data, SPLAT_ROW)
        colors = rows["colors"] / 255
        sh = (colors[:, None, :3] - 0.5) / SH_C0
        quats = (rows["quats"].astype(np.float64) - 128) / 128
        quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), others.LEAST_SCALE)  # Rounded to bytes.
        numbers = (rows["means"], quats, rows["scales"], colors[:, 3], sh)
        return others.model_of_splats(others.Ellipsoids(*(values.astype(np.float32) for values in numbers)), path)


def _color_bytes(splats: others.Ellipsoids) -> np.ndarray:
    """Return colours of degree 0 and opacities [N, 4] as bytes."""
    colors = np.concatenate([0.5 + SH_C0 * splats.sh[:, 0], splats.opacities[:, None]], axis=1)
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)


# .ksplat

HEADER_BYTES, SECTION_BYTES = 4096, 1024
KSPLAT_HEADER = struct.Struct("<2B2x4IH2x5f")
"""Version, largest and present number of sections, of splats, level, centre of the scene, least and largest number of
the spherical harmonics of level 2."""
KSPLAT_SECTION = struct.Struct("<4IfH2x4IH")
"""Present and largest number of splats, bucket size, number of buckets, their side, bytes of a bucket's centre, range
of positions, bytes, numbers of full and partially filled buckets, degree of spherical harmonics."""
KSPLAT_VERSION = (0, 1)
BUCKET_BYTES = 12
DEFAULT_RANGE, DEFAULT_ENDS = 32767, (-1.5, 1.5)
KSPLAT_DEGREE = 2


def encode_ksplat(placed: others.PlacedSplats) -> bytes:
    """Return splats as a *.ksplat of compression level 0, with degrees up to 2."""
    splats = placed.splats
    num = len(splats.means)
    degree = min(NUM_BASES.index(splats.sh.shape[1]), KSPLAT_DEGREE)
    rows = np.zeros(num, _ksplat_rows(0, degree))
    rows["means"], rows["scales"], rows["quats"] = splats.means, splats.scales, splats.quats
    rows["colors"] = _color_bytes(splats)
    bands = [splats.sh[:, band**2 : (band + 1) ** 2] for band in range(1, degree + 1)]
    if bands:
        # Degree by degree, and channel by channel within each.
        rows["rest"] = np.concatenate([band.transpose(0, 2, 1).reshape(num, -1) for band in bands], axis=1)
    counts = (1, 1, num, num, 0)
    header = KSPLAT_HEADER.pack(*KSPLAT_VERSION, *counts, 0.0, 0.0, 0.0, *DEFAULT_ENDS).ljust(HEADER_BYTES, b"\0")
    section = KSPLAT_SECTION.pack(num, num, 0, 0, 0.0, 0, 0, rows.nbytes, 0, 0, degree).ljust(SECTION_BYTES, b"\0")
    return header + section + rows.tobytes()


def load_ksplat(path: str | os.PathLike[str]) -> Model:
    """Read Gaussians of any compression level, in the world of the file. Ellipsoids are flattened as in `load_ply`.
    FileNotFoundError: there is no such file. ValueError: it is not a .ksplat, cut off, inconsistent, or empty."""
    data = existing_bytes(path, "file")
    with reading(path):
        with np.errstate(over="ignore", invalid="ignore"):  # Rows that are not finite are dropped.
            splats = _ksplat_splats(data)
        return others.model_of_splats(splats, path)


def _ksplat_splats(data: bytes) -> others.Ellipsoids:
    """Return the splats of all sections."""
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
    found = []
    for index in range(num_sections):
        section = KSPLAT_SECTION.unpack_from(data, HEADER_BYTES + index * SECTION_BYTES)
        splats, start = _ksplat_section(data, start, section, level, ends)
        found.append(splats)
    # Sections may differ in degree: lower ones are padded with zeros.
    num_bases = max((splats.sh.shape[1] for splats in found), default=1)
    padded = [
        splats._replace(sh=np.pad(splats.sh, ((0, 0), (0, num_bases - splats.sh.shape[1]), (0, 0)))) for splats in found
    ]
    if not sum(len(splats.means) for splats in found):
        raise ValueError("holds no splats")
    return others.Ellipsoids(*(np.concatenate(columns) for columns in zip(*padded, strict=True)))


def _ksplat_section(
    data: bytes, start: int, section: tuple[Any, ...], level: int, ends: tuple[float, float]
) -> tuple[others.Ellipsoids, int]:
    """Return the splats of a section that begins at a byte, and the byte after it."""
    num, most, size, num_buckets, side, centre_bytes, reach, _, num_full, num_partial, degree = section
    if degree >= len(NUM_BASES) or num > most or num_full + num_partial != num_buckets:
        raise ValueError(
            f"is damaged: a section has {num} of {most} splats of degree {degree}, and {num_full} full and "
            f"{num_partial} other buckets of {num_buckets}"
        )
    if num_buckets and centre_bytes != BUCKET_BYTES:
        raise ValueError(f"is damaged: a section has bucket centres of {centre_bytes} bytes, not {BUCKET_BYTES}")
    dtype = _ksplat_rows(level, degree)
    first = start + 4 * num_partial + BUCKET_BYTES * num_buckets
    # A section reserves room for its largest number of splats, not for those that it has.
    stop = first + most * dtype.itemsize
    if stop > len(data):
        raise ValueError(f"is cut off: a section ends at byte {stop:,} of {len(data):,}")
    rows = np.frombuffer(data, dtype, num, first)
    means = rows["means"].astype(np.float64)
    if level:
        partial = np.frombuffer(data, "<u4", num_partial, start).astype(np.int64)
        bounds = np.cumsum(np.concatenate([np.full(num_full, size, np.int64), partial]))
        if num > (bounds[-1] if num_buckets else 0):
            raise ValueError(f"is damaged: the buckets of a section have fewer than its {num} splats")
        centres = np.frombuffer(data, "<f4", 3 * num_buckets, start + 4 * num_partial).reshape(-1, 3)
        reach = reach or DEFAULT_RANGE
        # side right: splat i is in the first bucket that ends beyond i.
        bucket = np.searchsorted(bounds, np.arange(num), side="right")
        # Codes 0 to 2·reach are −side/2 to side/2 around the bucket's centre.
        means = (means - reach) * (side / 2 / reach) + centres[bucket]
    rest = np.asarray(rows["rest"], np.float64)
    if level == 2:
        rest = ends[0] + rest / 255 * (ends[1] - ends[0])
    colors = rows["colors"] / 255
    sh = np.zeros((num, NUM_BASES[degree], 3))
    sh[:, 0] = (colors[:, :3] - 0.5) / SH_C0
    for band in range(1, degree + 1):
        low, high = band**2, (band + 1) ** 2
        sh[:, low:high] = rest[:, 3 * (low - 1) : 3 * (high - 1)].reshape(num, 3, high - low).transpose(0, 2, 1)
    numbers = (means, rows["quats"], rows["scales"], colors[:, 3], sh)
    return others.Ellipsoids(*(values.astype(np.float32) for values in numbers)), stop


def _ksplat_rows(level: int, degree: int) -> np.dtype:
    """Return the bytes of one splat."""
    mean, number, rest = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    return np.dtype(
        [
            ("means", mean, 3), ("scales", number, 3), ("quats", number, 4), ("colors", "u1", 4),
            ("rest", rest, (3 * (NUM_BASES[degree] - 1),)),
        ]
    )  # fmt: skip
