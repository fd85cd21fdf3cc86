"""Splat files of other programs: SPZ, SOG, compressed PLY and .splat by the library gaussforge, and .ksplat.

Gaussians reach gaussforge as a PLY file in memory. Rows are in Z-curve order, and all have one third scale, the
smallest: formats that round scales by a table then spend one entry on it. If a format can mark splats as flat, its
file does. gaussforge 0.6 writes the spherical harmonics of compressed PLY in another order than it reads them; here
they have SuperSplat's order. GaussianSplats3D finds no splats in its .ksplat files.

A *.ksplat of GaussianSplats3D, version 0.1, is a header of 4096 bytes, then one of 1024 for each section, then the
sections. Splats are rows of fixed size: position, scales, rotation (wxyz), colour of degree 0 and opacity in a byte
each, and spherical harmonics, degree by degree and within each channel by channel. Compression level 0 has floats.
Level 1 has halves, and positions as 16 bits around the centre of a bucket; level 2 is level 1 with spherical harmonics
in bytes. A section of level 1 or 2 begins with the lengths of its partially filled buckets and the centres of all
buckets. Its splats are in bucket order, full buckets first. Files are written at level 0, up to degree 2, the most that
GaussianSplats3D reads.
"""

import dataclasses
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.gaussians import SH_C0, Gaussians
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.data.ply import OFFSET, ROTATION, turn_of
from a2tg_jax.host.atomic import write_whole
from a2tg_jax.host.operating_system import printing_to_stderr
from a2tg_jax.host.optional import optional
from a2tg_jax.host.regular_files import room_of
from a2tg_jax.host.text import shortened
from a2tg_jax.io import other_programs as others
from a2tg_jax.io.columns import morton
from a2tg_jax.io.ply import FLAT_MARK, decode_ply, encode_ply, place_comments, place_marks
from a2tg_jax.io.validate import check_model, existing_bytes, reading
from a2tg_jax.model import Model

KINDS = ("compressed.ply", "spz", "sog", "splat")
"""gaussforge's names of formats, which are the suffixes."""
LEAST_LOG_SCALE = -20.0
CURVE_BITS = 16
SOG_HEADER, SOG_FLAT = "meta.json", "2dgs"
MOST_HEADER_BYTES = 1 << 24


def save_by_gaussforge(
    path: str | os.PathLike[str], model: Gaussians | Model, *, world: others.World = "original"
) -> None:
    """Write the Gaussians of a model, in its original world or upright, in the format of the suffix.

    Positions that the format would round too far are relative to whole numbers, which a warning names, as do the files
    of compressed PLY and SOG. Another warning follows if rounding still exceeds a tenth of a typical scale.

    Raises:
      ValueError: if gaussforge is not installed or cannot write them, there are none, or the format cannot hold their
        positions.
    """
    kind = _kind_of(path)
    gaussians, offset, _, turn = others.world_gaussians(model, kind=kind, world=world)
    if not gaussians.num:
        raise ValueError(f"{path}: the model has no Gaussians; a file of this format has at least one")
    others.check_positions(kind, gaussians, str(path))
    # In the order of a Z curve through the means.
    means = np.asarray(gaussians.means, np.float64)
    low, high = means.min(axis=0, initial=0.0), means.max(axis=0, initial=0.0)
    # 1e-30: all means may be equal along an axis.
    codes = ((means - low) / np.maximum(high - low, 1e-30) * (2**CURVE_BITS - 1)).astype(np.int64)
    # stable: equal codes keep their order, so that files repeat.
    gaussians = gaussians[np.argsort(morton(codes.T, CURVE_BITS), kind="stable")]
    third = others.third_log_scales(np.asarray(gaussians.log_scales)).min(axis=0, keepdims=True, initial=0.0)
    if kind == "compressed.ply":
        # gaussforge mistakes channel-by-channel SH above degree 0 for coefficient-by-coefficient.
        sh = np.asarray(gaussians.sh)
        rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, sh.shape[1] - 1, 3)
        gaussians = dataclasses.replace(gaussians, sh=jnp.asarray(np.concatenate([sh[:, :1], rest], axis=1)))
    ply = encode_ply(gaussians, np.repeat(third.clip(LEAST_LOG_SCALE), gaussians.num, axis=0))
    data = _marked(_converted(ply, "ply", kind, Path(path)), kind, offset, turn)
    write_whole(path, data)
    others.warn_of_offset(kind, offset, path)


def load_by_gaussforge(path: str | os.PathLike[str]) -> Model:
    """Read Gaussians from a file, in its world. Ellipsoids are flattened as `load_ply` does, with a warning.

    The model's origin has the offset and the rotation of a SOG file, if there are any.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if gaussforge is not installed or cannot read the file, or a number is not finite.
    """
    kind, path, data = _kind_of(path), Path(path), existing_bytes(path, "file")
    header: dict[str, Any] = {}
    if kind == "sog":
        header, data = _checked_sog(data, path)
    converted = _converted(data, kind, "ply", path)
    gaussians = decode_ply(io.BytesIO(converted), path, is_flat=header.get("model") == SOG_FLAT).gaussians
    with reading(path):
        quat = np.array(header.get(ROTATION, (1, 0, 0, 0)), np.float64).reshape(4)
        origin = others.origin_at(np.array(header.get(OFFSET, (0, 0, 0)), np.float64).reshape(3), turn_of(quat))
    return Model(gaussians, origin=origin)


def _checked_sog(data: bytes, path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the header of a SOG file, a ZIP, and the file written again.

    gaussforge checks neither checksums nor the ZIP's own tables: damaged ones end the process or change numbers.

    Raises:
      ValueError: if the file is damaged, or unpacks to more than 64 times its size.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > room_of(len(data)):
                raise ValueError("it unpacks to more than 64 times its size")
            contents = {entry.filename: archive.read(entry) for entry in archive.infolist()}
        found = json.loads(contents[SOG_HEADER][:MOST_HEADER_BYTES])
    except KeyError:
        raise ValueError(f"{path}: is not SOG: it has no {SOG_HEADER}") from None
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path}: is damaged or no SOG file: {shortened(str(error))}") from error
    return (found if isinstance(found, dict) else {}), _zipped(contents)


def _zipped(contents: Mapping[str, bytes]) -> bytes:
    """Return a ZIP of files by name, always the same."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in contents.items():
            # A fresh ZipInfo has a fixed date.
            archive.writestr(zipfile.ZipInfo(name), content)
    return data.getvalue()


def import_gaussforge(path: Path) -> Any:
    """Return the library for a file. ValueError: it is not installed."""
    return optional("gaussforge", f"{path}: needs gaussforge", "formats")


def _kind_of(path: str | os.PathLike[str]) -> str:
    """Return gaussforge's name of the format of a file."""
    return next(kind for kind in KINDS if Path(path).name.lower().endswith(f".{kind}"))


def _converted(data: bytes, before: str, after: str, path: Path) -> bytes:
    """Return the bytes of one format as another's."""
    library = import_gaussforge(path)
    with printing_to_stderr():
        result = library.GaussForge().convert(data, before, after)
    converted: bytes = result.get("data", b"")
    if not converted:
        reason = shortened(str(result.get("error", "no splats in it")), 200)
        raise ValueError(f"{path}: gaussforge reports: {reason}; the file is damaged, or of another format")
    return converted


def _marked(data: bytes, kind: str, offset: np.ndarray, turn: np.ndarray) -> bytes:
    """Return a file with marks for flat splats, the offset and the rotation, if its format has them."""
    if kind == "compressed.ply":
        # Comments of a PLY follow its format line.
        return data.replace(b" 1.0\n", f" 1.0\ncomment {FLAT_MARK}\n{place_comments(offset, turn)}".encode(), 1)
    if kind != "sog":
        return data
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    header = {**json.loads(contents[SOG_HEADER]), "model": SOG_FLAT}
    header |= {word: numbers.tolist() for word, numbers in place_marks(offset, turn).items()}
    return _zipped(contents | {SOG_HEADER: json.dumps(header, separators=(",", ":")).encode()})


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


def save_ksplat(path: str | os.PathLike[str], model: Gaussians | Model, *, world: others.World = "original") -> None:
    """Write the Gaussians of a model, in its original world or upright, at compression level 0, with degrees up to 2.

    Positions that float32 would round too far are relative to whole numbers, which a warning names.

    Raises:
      ValueError: if there are none, or they would not load.
    """
    gaussians, offset, *_ = others.world_gaussians(model, world=world)
    if not gaussians.num:
        raise ValueError(f"{path}: the model has no Gaussians; a file of this format has at least one")
    check_model(Model(gaussians))
    splats = others.splats_of(Model(gaussians))
    degree = min(gaussians.sh_degree, KSPLAT_DEGREE)
    rows = np.zeros(gaussians.num, _ksplat_rows(0, degree))
    rows["means"], rows["scales"], rows["quats"] = splats.means, splats.scales, splats.quats
    colors = np.concatenate([0.5 + SH_C0 * splats.sh[:, 0], splats.opacities[:, None]], axis=1)
    rows["colors"] = np.rint(255 * np.clip(colors, 0, 1))
    bands = [splats.sh[:, band**2 : (band + 1) ** 2] for band in range(1, degree + 1)]
    if bands:
        # Degree by degree, and channel by channel within each.
        rows["rest"] = np.concatenate([band.transpose(0, 2, 1).reshape(len(rows), -1) for band in bands], axis=1)
    num = gaussians.num
    header = KSPLAT_HEADER.pack(*KSPLAT_VERSION, 1, 1, num, num, 0, 0.0, 0.0, 0.0, *DEFAULT_ENDS).ljust(
        HEADER_BYTES, b"\0"
    )
    section = KSPLAT_SECTION.pack(num, num, 0, 0, 0.0, 0, 0, rows.nbytes, 0, 0, degree).ljust(SECTION_BYTES, b"\0")
    write_whole(path, header + section + rows.tobytes())
    others.warn_of_offset("ksplat", offset, path)


def load_ksplat(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians of any compression level, in the world of the file. Ellipsoids are flattened as in `load_ply`.
    FileNotFoundError: there is no such file. ValueError: it is not a .ksplat, cut off, inconsistent, or empty."""
    data = existing_bytes(path, "file")
    with reading(path):
        with np.errstate(over="ignore", invalid="ignore"):  # Rows that are not finite are dropped.
            splats = _ksplat_splats(data)
        gaussians = others.gaussians_of(splats, path, is_flat=False)
        check_model(Model(gaussians))
    return gaussians


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
