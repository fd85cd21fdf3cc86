"""SOG files of PlayCanvas, versions 1 and 2: JSON and pictures, one pixel for each splat.

A *.sog is a ZIP of `meta.json` and pictures in lossless WebP or PNG; the same files may be in a folder. Red, green and
blue of means_l and means_u are the low and high bytes of sign(x)·ln(1 + |x|) in even steps between two ends. A rotation
is its three smaller numbers; 252 plus the index (wxyz) of the largest is alpha. Scales, colours of degree 0 and
spherical harmonics are places in codebooks of 256 numbers; in version 1, even steps between two ends. shN_centroids
has 64 sets of coefficients a row, and shN_labels has 16-bit places among them. The specification is at
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.

Every size, count and index is checked before it is used. `offset` and `rotation` in meta.json are ours, as in a PLY.
"""

import io
import json
import math
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError
from scipy.cluster.vq import kmeans2, vq

from a2tg_jax import Model
from a2tg_jax.base.checks import check_int
from a2tg_jax.base.json_text import number_array, parse_json
from a2tg_jax.base.regular_files import existing_bytes, read_regular, reading, room_of
from a2tg_jax.base.text import PROGRAM, shortened
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.data.decoding import MOST_BYTES
from a2tg_jax.data.ply import OFFSET, ROTATION, turn_of
from a2tg_jax.io.columns import LONGEST_WEBP_SIDE, opacities_of
from a2tg_jax.io.gltf_container import LONGEST_NAME
from a2tg_jax.io.other_programs import (
    Ellipsoids,
    PlacedSplats,
    model_of_splats,
    origin_at,
    with_largest,
    without_largest,
)
from a2tg_jax.io.ply import place_marks

HEADER = "meta.json"
STREAMED_HEADER = "lod-meta.json"
STREAMED = "is streamed SOG, which has its splats in folders: unpack it, and read one of them, such as 0_0"
FLAT = "2dgs"
VERSION = 2
PICTURES = {"means": 2, "quats": 1, "scales": 1, "sh0": 1, "shN": 2}
"""Number of pictures of each group."""
PICTURE_FORMATS = ("WEBP", "PNG")
LEVELS = 2**16 - 1
LARGEST_INDEX_0 = 252
"""Alpha of a rotation whose w is the largest number."""
CODEBOOK = 256
ENTRIES_A_ROW = 64
MOST_ENTRIES = 2**16
"""Largest number of sets of spherical harmonics that labels of 16 bits can distinguish."""
COEFFICIENTS = tuple(num - 1 for num in NUM_BASES)
"""Number of coefficients above degree 0, by degree."""


# Reading


class _Files(NamedTuple):
    """Header and pictures of a SOG file, not yet decoded."""

    header: dict[str, Any]
    pictures: Mapping[str, bytes]
    """By name."""
    num_bytes: int
    """Bytes of the whole file."""


def load_sog(path: Path) -> Model:
    """Read Gaussians from a *.sog or from the meta.json of a folder, in the world of the file.

    Ellipsoids are flattened as `load_ply` does, with a warning. The model's origin has the offset and the rotation of
    the file, if there are any.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not SOG or damaged, naming the picture, or a number is not finite.
    """
    data = existing_bytes(path, "file")
    with reading(path):
        files = _read_folder(path, data) if path.name.lower().endswith(HEADER) else _read_archive(data)
        header = files.header
        with np.errstate(over="ignore", invalid="ignore"):  # Rows that are not finite are left out.
            splats = _splats(files)
        offset = _numbers(header, OFFSET, 3) if OFFSET in header else np.zeros(3)
        quat = _numbers(header, ROTATION, 4) if ROTATION in header else None
        origin = origin_at(offset, turn_of(quat))
        return model_of_splats(splats, path, is_flat=header.get("model") == FLAT, origin=origin)


def sog_files(path: Path) -> list[Path]:
    """Return the files of an unbundled SOG, meta.json first; it alone if it cannot be read."""
    try:
        header = _checked_header(existing_bytes(path, "file"))
        return [path, *(path.parent / name for name in _named_pictures(header))]
    except (OSError, ValueError):
        return [path]


def _read_folder(path: Path, data: bytes) -> _Files:
    header = _checked_header(data)
    pictures = {}
    for name in _named_pictures(header):
        try:
            pictures[name] = read_regular(path.parent / name, MOST_BYTES)
        except FileNotFoundError:
            raise ValueError(f"the picture {name}, which it names, is missing in {path.parent}") from None
    return _Files(header, pictures, len(data) + sum(map(len, pictures.values())))


def _read_archive(data: bytes) -> _Files:
    """Return the files of a ZIP, which are in its root or in one folder. ValueError: it is damaged, or unpacks to more
    than 64 times its size."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > room_of(len(data)):
                raise ValueError("it unpacks to more than 64 times its size")
            # Some programs on Windows write backslashes.
            names = {name.replace("\\", "/"): name for name in archive.namelist()}
            # Desktops zip a folder together with its name, and macOS adds a second folder.
            headers = [name for name in names if PurePosixPath(name).name == HEADER and name.count("/") < 2]
            if not headers:
                is_streamed = any(PurePosixPath(name).name == STREAMED_HEADER for name in names)
                raise ValueError(STREAMED if is_streamed else f"is not SOG: it has no {HEADER}")
            if len(headers) > 1 and HEADER not in headers:
                raise ValueError(f"holds several scenes ({', '.join(headers[:3])}); unpack it, and give one folder")
            place = HEADER if HEADER in headers else headers[0]
            header = _checked_header(archive.read(names[place]))
            folder = place.removesuffix(HEADER)
            pictures = {}
            for name in _named_pictures(header):
                if folder + name not in names:
                    raise ValueError(f"lacks the picture {folder + name}, which its {HEADER} names")
                pictures[name] = archive.read(names[folder + name])
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"is damaged or no SOG file: {shortened(str(error))}") from error
    return _Files(header, pictures, len(data))


def _checked_header(data: bytes) -> dict[str, Any]:
    try:
        header = parse_json(data)
    except ValueError as error:
        raise ValueError(f"{HEADER} cannot be read as JSON ({error})") from error
    if isinstance(header, dict) and "lodLevels" in header:
        raise ValueError(STREAMED)
    if not isinstance(header, dict) or not isinstance(header.get("means"), dict):
        raise ValueError(f"is not SOG: {HEADER} describes no means")
    version = header.get("version", 1)
    if version not in (1, VERSION):
        raise ValueError(f"is SOG of version {shortened(repr(version))}; versions 1 and 2 are read")
    return header


def _named_pictures(header: dict[str, Any]) -> list[str]:
    """Return the names of all pictures. ValueError: one is missing, or is no plain name."""
    names: list[str] = []
    for group, count in PICTURES.items():
        if group == "shN" and not header.get(group):
            continue
        described = header.get(group)
        if not isinstance(described, dict):
            raise ValueError(f"{HEADER} describes no {group}; got {shortened(described)}")
        pictures: Any = described.get("files")
        is_list = isinstance(pictures, list) and len(pictures) == count
        if not is_list or not all(isinstance(name, str) for name in pictures):
            raise ValueError(f"{HEADER} must name {count} pictures of {group}; got {shortened(pictures)}")
        for name in pictures:
            is_plain = PurePosixPath(name).name == name and "\\" not in name and "\0" not in name
            if not is_plain or len(name) > LONGEST_NAME:
                raise ValueError(
                    f"{HEADER} names the picture {shortened(name)}; a short name without folders is wanted"
                )
        names += pictures
    return names


def _splats(files: _Files) -> Ellipsoids:
    header = files.header
    is_first = header.get("version", 1) == 1
    num = header["means"]["shape"][0] if is_first else header["count"]
    check_int(f"the number of splats in {HEADER}", num, 1)
    has_rest = bool(header.get("shN")) and header["shN"].get("bands") != 0
    names = [name for group in ("means", "quats", "scales", "sh0") for name in header[group]["files"]]
    if has_rest:
        names.append(header["shN"]["files"][1])
    low, high, turns, scale_codes, color_codes, *labels = _rows(files, names, num)
    first, last = (_numbers(header["means"], name, 3, "means.") for name in ("mins", "maxs"))
    steps = low[:, :3] + 256 * high[:, :3].astype(np.int64)
    logarithms = first + steps / LEVELS * (last - first)
    means = np.sign(logarithms) * np.expm1(np.abs(logarithms))

    bad = np.count_nonzero(turns[:, 3] < LARGEST_INDEX_0)
    if bad:
        raise ValueError(
            f"{header['quats']['files'][0]} is damaged: alpha of a rotation is {LARGEST_INDEX_0} to 255, but {bad:,} "
            "pixels have less"
        )
    smaller = (turns[:, :3] / 255 * 2 - 1) / math.sqrt(2)
    quats = with_largest(smaller, turns[:, 3].astype(np.int64) - LARGEST_INDEX_0)

    scales = np.exp(_decoded(header, "scales", scale_codes[:, :3], is_first=is_first))
    if is_first:  # The fourth column is the logit of the opacity.
        colors = _decoded(header, "sh0", color_codes, is_first=True)
        opacities = opacities_of(colors[:, 3])
    else:
        colors = _decoded(header, "sh0", color_codes[:, :3], is_first=False)
        opacities = color_codes[:, 3] / 255
    sh = colors[:, None, :3]
    if has_rest:
        places = labels[0][:, 0] + 256 * labels[0][:, 1].astype(np.int64)
        sh = np.concatenate([sh, _rest(files, places, is_first=is_first)], axis=1)
    return Ellipsoids.of(means, quats, scales, opacities, sh)


def _rest(files: _Files, places: np.ndarray, *, is_first: bool) -> np.ndarray:
    """Return the coefficients [N, K, 3] above degree 0 at these places [N] among the sets of a file."""
    described = files.header["shN"]
    centroids, labels = described["files"]
    pixels = _pixels(files, centroids)
    # Version 1 does not say the degree, which follows from the width.
    widths = {ENTRIES_A_ROW * count: degree for degree, count in enumerate(COEFFICIENTS) if degree}
    degree = widths.get(pixels.shape[1]) if is_first else described["bands"]
    if type(degree) is not int or widths.get(pixels.shape[1]) != degree:
        raise ValueError(
            f"{centroids} is {pixels.shape[1]} pixels wide, where degrees 1, 2 and 3 have {[*widths]}; {HEADER} says "
            f"degree {shortened(described.get('bands'))}"
        )
    room = ENTRIES_A_ROW * len(pixels)
    count = room if is_first else described["count"]
    check_int(f"the number of sets of spherical harmonics in {HEADER}", count, 1)
    if count > room:
        raise ValueError(f"{centroids} holds {room:,} sets of spherical harmonics, but {HEADER} says {count:,}")
    if places.max() >= count:
        raise ValueError(f"{labels} refers to set {places.max():,} of spherical harmonics (from 0) of {count:,}")
    sets = pixels[..., :3].reshape(room, COEFFICIENTS[degree], 3)
    used, inverse = np.unique(places, return_inverse=True)
    return _decoded(files.header, "shN", sets[used], is_first=is_first)[inverse]


def _rows(files: _Files, names: list[str], num: int) -> list[np.ndarray]:
    """Return the first pixels [num, 4] of pictures. ValueError: one has fewer, or they differ in size."""
    pictures = [_pixels(files, name) for name in names]
    for name, pixels in zip(names, pictures, strict=True):
        height, width, _ = pixels.shape
        if num > height * width:
            raise ValueError(f"{name} has {width}x{height} pixels, too few for {num:,} splats")
        if pixels.shape != pictures[0].shape:
            raise ValueError(f"{name} has {width}x{height} pixels, and {names[0]} another size")
    return [pixels.reshape(-1, 4)[:num] for pixels in pictures]


def _pixels(files: _Files, name: str) -> np.ndarray:
    """Return the pixels [height, width, 4] of a picture, uint8. ValueError, naming it: it is damaged, or too large."""
    data = files.pictures[name]
    # A picture of one colour has a few bytes, whatever its size.
    most = room_of(files.num_bytes) // 4
    try:
        with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as image:
            width, height = image.size
            if width * height <= most:
                if image.mode not in ("RGB", "RGBA"):
                    raise ValueError(f"its pixels are {image.mode}, not RGB or RGBA of 8 bits")
                # The chunk of lossless pixels.
                if image.format == "WEBP" and b"VP8L" not in data:
                    raise ValueError("it is compressed with loss, which changes its numbers")
                return np.asarray(image.convert("RGBA"))
    except UnidentifiedImageError:
        raise ValueError(f"the picture {name} is damaged, or neither WebP nor PNG") from None
    except Exception as error:  # Damaged pictures raise anything from SyntaxError to struct.error.
        reason = shortened(str(error) or type(error).__name__)
        raise ValueError(f"the picture {name} is damaged ({reason})") from error
    raise ValueError(f"{name} has {width}x{height} pixels, more than a file of {files.num_bytes:,} bytes may have")


def _decoded(header: Mapping[str, Any], group: str, codes: np.ndarray, *, is_first: bool) -> np.ndarray:
    """Return the numbers of bytes [..., C], by the group's codebook or, in version 1, its ends of each column."""
    described = header[group]
    if is_first:
        # One pair of ends for all spherical harmonics.
        count = 1 if group == "shN" else codes.shape[-1]
        low, high = (_numbers(described, name, count, f"{group}.") for name in ("mins", "maxs"))
        return low + codes / 255 * (high - low)
    codebook = described.get("codebook")
    if isinstance(codebook, list) and len(codebook) == CODEBOOK and codebook[0] is None:
        _, second, *_, last = number_array(codebook, CODEBOOK, f"{group}.codebook of {HEADER}", null=0.0).tolist()
        # Early programs left the first number out: https://github.com/playcanvas/engine reads it as one more step.
        codebook = [second + (second - last) / (CODEBOOK - 1), *codebook[1:]]
    book = number_array(codebook, None, f"{group}.codebook of {HEADER}")
    if codes.max() >= len(book):
        raise ValueError(f"{group}.codebook of {HEADER} has {len(book)} numbers, but a pixel refers to {codes.max()}")
    return book[codes]


def _numbers(described: Mapping[str, Any], name: str, count: int, group: str = "") -> np.ndarray:
    """Return a field of `count` numbers; one may be without a list."""
    values = described.get(name)
    return number_array(values if isinstance(values, list) else [values], count, f"{group}{name} of {HEADER}")


# Writing


def encode_sog(placed: PlacedSplats) -> bytes:
    """Return splats as a *.sog, always the same for the same splats."""
    splats = placed.splats
    num = len(splats.means)
    logarithms = np.sign(splats.means) * np.log1p(np.abs(splats.means.astype(np.float64)))
    low = logarithms.min(axis=0)
    high = logarithms.max(axis=0)
    shares = (logarithms - low) / np.where(high > low, high - low, 1.0)
    steps = np.rint(shares * LEVELS).astype(np.int64)
    largest, smaller = without_largest(splats.quats)
    turns = np.concatenate([255 * (smaller / math.sqrt(2) + 0.5), LARGEST_INDEX_0 + largest[:, None]], axis=1)
    scale_book, scale_codes = _coded(np.log(splats.scales))
    color_book, color_codes = _coded(splats.sh[:, 0])
    header: dict[str, Any] = {
        "version": VERSION, "asset": {"generator": PROGRAM}, "count": num, "model": FLAT,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }  # fmt: skip
    width = 4 * math.ceil(math.sqrt(num) / 4)
    pictures = {
        "means_l.webp": _webp(steps & 255, width), "means_u.webp": _webp(steps >> 8, width),
        "scales.webp": _webp(scale_codes, width), "quats.webp": _webp(turns, width),
        "sh0.webp": _webp(np.concatenate([color_codes, 255 * splats.opacities[:, None]], axis=1), width),
    }  # fmt: skip
    degree = NUM_BASES.index(splats.sh.shape[1])
    if degree:
        entries, labels = _palette(splats.sh[:, 1:].reshape(num, -1))
        book, codes = _coded(entries)
        names = ["shN_centroids.webp", "shN_labels.webp"]
        header["shN"] = {"count": len(entries), "bands": degree, "codebook": book, "files": names}
        pictures[names[0]] = _webp(codes.reshape(-1, 3), ENTRIES_A_ROW * COEFFICIENTS[degree])
        pictures[names[1]] = _webp(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1), width)
    header |= {word: numbers.tolist() for word, numbers in place_marks(placed.offset, placed.turn).items()}
    pictures[HEADER] = json.dumps(header, separators=(",", ":")).encode()
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in pictures.items():
            # A fresh ZipInfo has a fixed date.
            archive.writestr(zipfile.ZipInfo(name), content)
    return data.getvalue()


def _webp(values: np.ndarray, width: int) -> bytes:
    """Return numbers [n, 3] or [n, 4], rounded to bytes, as a picture. ValueError: it has too many pixels."""
    height = 4 * math.ceil(len(values) / width / 4)
    if max(width, height) > LONGEST_WEBP_SIDE:
        raise ValueError(f"{len(values):,} splats are too many for SOG; write *.ply or *.spz")
    pixels = np.zeros((width * height, values.shape[1]), np.uint8)
    pixels[: len(values)] = np.rint(values)
    file = io.BytesIO()
    # exact: colours under an alpha of 0 are numbers too.
    Image.fromarray(pixels.reshape(height, width, -1)).save(file, "WEBP", lossless=True, exact=True, method=4)
    return file.getvalue()


def _coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Return a codebook of 256 ascending numbers, and the nearest place in it for each value, uint8."""
    centres = np.unique(values.astype(np.float64))
    if len(centres) > CODEBOOK:
        counts, edges = np.histogram(values.astype(np.float64), CODEBOOK)
        # Half of the centres at even steps, so that outliers are kept. The others as dense as the cube root of the
        # values' density, where the squared error is least (Panter and Dite).
        weights = np.cbrt(counts)
        places = np.concatenate([[0.0], np.cumsum(weights / weights.sum() + 1 / CODEBOOK)])
        centres = np.interp(np.linspace(0, 2, CODEBOOK), places, edges)
    codes = np.searchsorted((centres[1:] + centres[:-1]) / 2, values.astype(np.float64)).astype(np.uint8)
    # Readers expect 256 numbers.
    return np.pad(centres, (0, CODEBOOK - len(centres)), mode="edge").tolist(), codes


LARGEST_GROUP = 2048
CLUSTER_STEPS = 5


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return up to 65,536 entries [E, D] for rows [N, D], and the entry [N] of each.

    More rows than that are halved along their widest direction until groups are small, and each group is clustered by
    k-means into its share of the entries: all of them together would be compared N × 65,536 times.
    """
    num = len(rows)
    if num <= MOST_ENTRIES:
        return rows, np.arange(num)
    groups = [np.arange(num)]
    while len(groups[0]) > LARGEST_GROUP:
        groups = [half for group in groups for half in _halves(rows, group)]
    share = MOST_ENTRIES // len(groups)
    labels = np.zeros(num, np.int64)
    entries = []
    for index, group in enumerate(groups):
        centres, nearest = _clustered(rows[group], share)
        entries.append(centres)
        labels[group] = index * share + nearest
    return np.concatenate(entries), labels


def _halves(rows: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a group on either side of the median along its widest direction."""
    members = rows[group]
    # Some rows are enough for a direction.
    sample = members[:: math.ceil(len(members) / LARGEST_GROUP)]
    widest = np.linalg.eigh(np.cov(sample, rowvar=False))[1][:, -1]
    order = np.argsort(members @ widest, kind="stable")
    middle = len(group) // 2
    return group[order[:middle]], group[order[middle:]]


def _clustered(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` centres [count, D] of rows [N, D] by k-means, and the nearest centre [N] of each row."""
    first = rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Centres without rows stay where they are.
        centres, _ = kmeans2(rows, first, CLUSTER_STEPS, minit="matrix")
    return centres, vq(rows, centres)[0]
