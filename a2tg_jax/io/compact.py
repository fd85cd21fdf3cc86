"""Compact scene files, *.a2tgz: a small file of a model, with a chosen number of bits for each group of numbers.

docs/formats.md describes the file. Rows come back in the order of a Z curve through the means, with quaternions of unit
length; the model looks the same up to rounding. Files for browsers (`io.web_scene`) have a coder that browsers decode,
and several chunks of rows, the most visible first, so that a page draws while it loads.
"""

import dataclasses
import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from a2tg_jax import Appearance, Model
from a2tg_jax.appearance.parts import MAX_DEGREE
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.checks import check_int, check_literal
from a2tg_jax.base.config_json import config_from_dict, config_to_dict
from a2tg_jax.base.json_text import parse_json
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.regular_files import existing_bytes, reading, room_of
from a2tg_jax.base.suffixes import checked_path
from a2tg_jax.io.columns import (
    MOST_BITS,
    AxisSteps,
    Choice,
    ColumnReader,
    ColumnWriter,
    Precision,
    checked_shapes,
    decode,
    ends_of,
    log_exponents_of,
    logits_of,
    morton,
    opacities_of,
    with_w,
)
from a2tg_jax.io.model_rows import Rows, check_encodable, joined_rows, model_of, ordered, rows_of_model
from a2tg_jax.model import check_is_model, checked_live
from a2tg_jax.model_file import (
    appearance_from_dict,
    appearance_to_dict,
    background_of,
    origin_arrays,
    origin_header,
    origin_of,
    origin_shapes,
)
from a2tg_jax.texture import MAX_SIDE

# As in PNG: CR LF shows a transfer as text, 0x1A ends a listing on Windows.
MAGIC = b"a2tgz\r\n\x1a"
VERSION = 3
OLD_VERSIONS = (1, 2)
"""Versions 1 and 2, without and with kernel shapes, had one chunk, a zstd header, and a table for each property of the
parts."""
HEAD = struct.Struct("<8sHIII")
"""Magic, version, header bytes as coded and as text, checksum of everything that follows."""
ORIGIN_DTYPES = {
    "viewmats": "f8", "Ks": "f8", "sizes": "i4", "is_test": "u1", "scale": "f8", "rotation": "f8", "translation": "f8",
}  # fmt: skip
COLORED = {"sh_0", "sh_1", "sh_2", "sh_3", "texel_colors"}
"""Names of the parts whose columns are red, green and blue."""
MARKS = ("floaters", "subject")
"""Names of the parts with a byte a row, which only files for browsers have: scores of floaters, and 1 for the
subject."""
LARGEST_CHUNK = 16384
LEAST_CHUNK = 256
"""Limits of the number of rows in a chunk of a file for browsers."""


@dataclasses.dataclass(frozen=True)
class CompactChoices(NamedFields):
    """Precision of each group of numbers: 1 to 16 bits, in even steps from the smallest to the largest, or floats.

    The defaults cost a few hundredths of a decibel.
    """

    means: Precision = 14
    """Precision of each axis; with bits, steps grow with the distance from the median."""
    log_scales: Precision = 8
    """Precision of the logarithms of both scales."""
    quats: Precision = 8
    """Precision of each of three numbers."""
    opacities: Precision = 6
    """Precision of the opacities as bits, or of their logits as floats."""
    sh_0: Precision = 8
    """Precision of the spherical harmonics of degree 0."""
    sh_rest: Precision = 5
    """Precision of the higher degrees, each with its own range."""
    texels: Precision = 7
    """Precision of RGB and alpha, each with its own range."""
    shapes: Precision = 8
    """Precision of the logarithms of the kernels' exponents as bits, or of their shapes as floats."""
    coder: Choice = "smallest"
    """Coder of all parts: lzma (Python's own), zstd, webp (lossless images), deflate, none, or the smallest for each
    part. Browsers show files of the coders deflate and none that have at most 8 bits in all groups but the means."""

    def keeping(self, others: Mapping[str, Any]) -> Self:
        """Return the choices with some changed, by name."""
        return dataclasses.replace(self, **others)

    def of_part(self, name: str) -> Precision:
        """Return the precision of a part of the file, such as sh_2 or texel_colors."""
        if name.startswith("texel_"):
            return self.texels
        if name.startswith("sh_") and name != "sh_0":
            return self.sh_rest
        return getattr(self, name)

    def check(self) -> Self:
        """Raise ValueError, naming the choice, if one is invalid."""
        for name in GROUPS:
            precision = getattr(self, name)
            # Not isinstance: True would pass for one bit.
            is_bits = type(precision) is int and 1 <= precision <= MOST_BITS
            if not is_bits and precision not in ("float32", "float16"):
                raise ValueError(f"choices.{name} must be 1 to {MOST_BITS} bits, float32 or float16; got {precision!r}")
        check_literal("choices.coder", self.coder, Choice)
        return self


Grids = Mapping[str, tuple[float, ...]]
"""First and last step of each group kept in bits, by the name of its part of the file; for each axis of the means,
centre and spread come first."""
GROUPS = tuple(field.name for field in dataclasses.fields(CompactChoices) if field.name != "coder")
DEFAULT_CHOICES = CompactChoices()


def save_compact(
    path: str | os.PathLike[str],
    model: Model,
    *,
    choices: CompactChoices = DEFAULT_CHOICES,
    grids: Grids | None = None,
) -> None:
    """Write a model's live rows, appearance and origin as a small file.

    Args:
      path: the file, conventionally *.a2tgz; an existing one is replaced once the new one is complete.
      model: of Gaussians with or without textures, exponents and bands.
      choices: precision of its numbers.
      grids: grids of the groups in bits for which the model was tuned (`tune_compact`); None: from the smallest to the
        largest of the model's own numbers.

    Raises:
      ValueError: if the model has another appearance or a number that is not finite or too large, or a choice is
        invalid.

    Examples:
      >>> a2tg.save_compact("scene.a2tgz", model, choices=a2tg.CompactChoices(means=16, sh_rest=4))
      >>> Path("scene.a2tgz").stat().st_size < model.num_bytes / 2
      True
    """
    path = checked_path(path, "save_compact")
    check_is_model(model)
    data = encode_model(model, choices, grids)
    write_whole(path, data)


def load_compact(path: str | os.PathLike[str]) -> Model:
    """Read the model of a compact file.

    Args:
      path: the file, conventionally *.a2tgz.

    Returns:
      The model, float32, its rows in the order of the file.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a compact scene, is damaged, or has another version.

    Examples:
      >>> a2tg.save_compact("scene.a2tgz", model)
      >>> a2tg.load_compact("scene.a2tgz").num
      200
    """
    path = checked_path(path, "load_compact")
    return decode_model(existing_bytes(path, "compact scene"), str(path))


def encode_model(
    model: Model,
    choices: CompactChoices = DEFAULT_CHOICES,
    grids: Grids | None = None,
    *,
    order: np.ndarray | None = None,
    page: Mapping[str, object] | None = None,
    marks: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> bytes:
    """Return the bytes that `save_compact` writes. Raises the same errors.

    Args:
      model: as in `save_compact`; with grids, a model of `half_turned` whose numbers may have changed since.
      choices: as in `save_compact`.
      grids: as in `save_compact` (`grids_of`); numbers beyond their ends are clipped.
      order: indices [N] of existing rows, for chunks that are drawn as they arrive; None for a single chunk.
      page: header entry for the viewer.
      marks: bytes [N] of the rows that exist, for the viewer, by names of `MARKS`.
    """
    choices.check()
    check_encodable(model.appearance)
    model = checked_live(model)
    rows = rows_of_model(model)
    num = len(rows.means)
    known = grids or {}
    axes, keys = _on_curve(rows.means, choices.means, known.get("means", ()))
    # A page draws after a sixteenth of a small scene; chunks of a large one are short enough to draw after each.
    chunk = max(num, 1) if order is None else int(np.clip(-(-num // 16), LEAST_CHUNK, LARGEST_CHUNK))
    starts = range(0, max(num, 1), chunk)
    order = np.arange(num) if order is None else order
    # Within each chunk, rows follow the Z curve: neighbours in space have similar numbers, which code well.
    order = np.concatenate([part[np.argsort(keys[part], kind="stable")] for part in np.split(order, starts[1:])])
    keys = keys[order]
    # With given grids no splat is turned: its numbers were tuned as they are.
    rows = ordered(rows, order, turns=grids is None)
    degrees, degree_ids, degree_counts = np.unique(rows.degrees, return_inverse=True, return_counts=True)
    header: dict[str, Any] = {
        "num": num,
        "chunk": chunk,
        "base_degree": model.gaussians.sh_degree,
        "choices": config_to_dict(choices),
        "appearance": appearance_to_dict(model.appearance),
        "background": list(model.background),
        "degrees": degrees.tolist(),
        "degree_counts": degree_counts.tolist(),
    }
    if rows.sizes is not None:
        # A pair of sides as one number, which orders pairs by height, then by width.
        pairs = rows.sizes @ [MAX_SIDE + 1, 1]
        pairs, size_ids, size_counts = np.unique(pairs, return_inverse=True, return_counts=True)
        sizes = np.stack(np.divmod(pairs, MAX_SIDE + 1), axis=1)
        header |= {"sizes": sizes.tolist(), "size_counts": size_counts.tolist()}
    if page is not None:
        header["page"] = dict(page)
    # Of all rows, so that all chunks have the same steps.
    ends: dict[str, Sequence[float]] = {}
    if isinstance(choices.means, int):
        ends["means"] = [number for axis in axes for number in axis]
    for name, values in _columns(rows, choices):
        precision = choices.of_part(name)
        if isinstance(precision, int):
            ends[name] = known[name] if name in known else ends_of(values, precision)
    writer = ColumnWriter(ends)
    if model.origin is not None:
        header["origin"] = origin_header(model.origin)
        for name, array in origin_arrays(model.origin).items():
            writer.exact(f"origin_{name}", np.asarray(array, ORIGIN_DTYPES[name]))
    for places in np.split(np.arange(num), starts[1:]):
        part = rows if len(starts) == 1 else ordered(rows, places, turns=False)
        if isinstance(choices.means, int):
            writer.means(keys[places], choices.means)
        else:
            writer.numbers("means", part.means.T, choices.means)
        writer.indices("degrees", degree_ids[places], len(degrees))
        if rows.sizes is not None:
            writer.indices("sizes", size_ids[places], len(sizes))
        for name, values in _columns(part, choices):
            writer.numbers(name, values, choices.of_part(name), is_color=name in COLORED)
        for name, of_rows in marks.items():
            writer.planes(name, of_rows[order[places]][None])
    data = framed(header, writer, choices.coder)
    # Very repetitive numbers are not coded: readers would take the file for a decompression bomb.
    return data if writer.num_unpacked <= room_of(len(data)) else framed(header, writer, "none")


def _on_curve(means: np.ndarray, precision: Precision, known: Sequence[float]) -> tuple[list[AxisSteps], np.ndarray]:
    """Return the steps of each axis, and the places [N] along the Z curve of means [N, 3] on these steps.

    Args:
      means: the positions.
      precision: precision of the means.
      known: centre, spread, first and last step of each axis, for a tuned model, whose numbers are on these steps:
        others would round them again. Empty: the steps follow from the means.
    """
    # Means kept as floats still need an order along the curve.
    bits = precision if isinstance(precision, int) else MOST_BITS
    axes = [AxisSteps(*steps) for steps in np.reshape(known, (-1, 4)).tolist()]
    if not axes:
        axes = [AxisSteps.of(x, bits) for x in means.T]
    codes = [axis.codes(x, bits) for axis, x in zip(axes, means.T, strict=True)]
    return axes, morton(np.stack(codes), bits)


def _columns(rows: Rows, choices: CompactChoices) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the numbers [C, n] of each part besides the means. Bits are of opacities and log-exponents,
    floats of logits and shapes."""
    yield "log_scales", rows.log_scales.T
    yield "quats", rows.quats[:, 1:].T
    has_bits = isinstance(choices.opacities, int)
    yield "opacities", (opacities_of(rows.logit_opacities) if has_bits else rows.logit_opacities)[None]
    for degree, band in enumerate(rows.bands):
        yield f"sh_{degree}", band.transpose(2, 1, 0).reshape(3, -1)
    if rows.texels is not None:
        yield "texel_colors", rows.texels[:, :3].T
        yield "texel_alphas", rows.texels[:, 3:].T
    if rows.shapes is not None:
        yield "shapes", (log_exponents_of(rows.shapes) if isinstance(choices.shapes, int) else rows.shapes)[None]


def half_turned(model: Model) -> Model:
    """Return the model as its file without rounding has it: rows along a Z curve, splats half-turned."""
    # An uncoded float32 file does all that writing does except rounding.
    exact = CompactChoices(coder="none").keeping(dict.fromkeys(GROUPS, "float32"))
    return decode_model(encode_model(model, exact))


def grids_of(model: Model, choices: CompactChoices) -> Grids:
    """Return the grids of a file with these choices, for each group in bits that the model has."""
    # Ends do not depend on the coder, and none is the fastest.
    header, _ = unframed(encode_model(model, dataclasses.replace(choices, coder="none")))
    return {name: tuple(ends) for name, ends in header["ends"].items()}


def decode_model(data: bytes, where: str = "the compact scene") -> Model:
    """Return the model of the bytes of a file; errors call it `where`. Raises as `load_compact` does."""
    with reading(where):
        header, body = unframed(data)
        choices = config_from_dict(CompactChoices, header["choices"], "choices").check()
        # Only classes of this package can be named, so that a file imports nothing.
        appearance = appearance_from_dict(header["appearance"])
        check_encodable(appearance)
        reader = ColumnReader(body, header["parts"], header["ends"], room_of(len(data)))
        num = header["num"]
        check_int("num", num, 0)
        chunk = header.get("chunk", max(num, 1))
        check_int("chunk", chunk, 1)
        found = {name for name, *_ in header["parts"]}
        parts = []
        for start in range(0, max(num, 1), chunk):
            length = min(chunk, num - start)
            parts.append(_rows_of(reader, length, header, choices, appearance))
            for name in MARKS:
                if name in found:
                    reader.planes(name, 1, length)  # They follow from the rows.
        origin = None
        if "origin" in header:
            arrays = {}
            for name, shape in origin_shapes(len(header["origin"]["names"])).items():
                arrays[name] = reader.exact(f"origin_{name}", shape, ORIGIN_DTYPES[name])
            # numpy's bool is a byte in the file, and `origin_of` takes no integers for it.
            arrays["is_test"] = arrays["is_test"].astype(bool)
            origin = origin_of(header["origin"], arrays)
        reader.end()
        return model_of(joined_rows(parts), header["base_degree"], appearance, origin, background_of(header))


def framed(header: Mapping[str, object], columns: ColumnWriter, coder: Choice) -> bytes:
    """Return the file with a header and columns."""
    parts, body = columns.coded(coder)
    whole = {**header, "parts": parts, "ends": columns.ends}
    # Browsers read the header with JSON.parse, which rejects NaN.
    text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
    coded = zlib.compress(text, 9)
    rest = coded + body
    return HEAD.pack(MAGIC, VERSION, len(coded), len(text), zlib.crc32(rest)) + rest


def unframed(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header and the body of a file."""
    if len(data) < HEAD.size or data[: len(MAGIC)] != MAGIC:
        raise ValueError("is not a compact scene of a2tg-jax")
    _, version, num_coded, num_text, checksum = HEAD.unpack_from(data)
    if version not in (*OLD_VERSIONS, VERSION):
        raise ValueError(f"is a compact scene of version {version}; this program reads versions 1 to {VERSION}")
    rest = data[HEAD.size :]
    # Before anything is decoded, so that a damaged file fails in one place.
    if zlib.crc32(rest) != checksum:
        raise ValueError("is damaged or cut off")
    if num_coded > len(rest) or num_text > room_of(len(data)):
        raise ValueError(f"announces a header of {num_coded} bytes, {num_text} unpacked")
    coder = "zstd" if version in OLD_VERSIONS else "deflate"
    header = parse_json(decode(coder, rest[:num_coded], 1, num_text).tobytes())
    if not isinstance(header, dict):
        raise ValueError("has no header")
    if version in OLD_VERSIONS:
        # JSON objects keep their order, which was the order of the parts.
        header["parts"] = [(name, header["coders"][name], length) for name, length in header["lengths"].items()]
    return header, rest[num_coded:]


def _rows_of(
    reader: ColumnReader, num: int, header: Mapping[str, Any], choices: CompactChoices, appearance: Appearance
) -> Rows:
    """Return the tables of a chunk; the reader limits their size by the file's."""

    def numbers(name: str, num_columns: int, length: int) -> np.ndarray:
        return reader.numbers(name, num_columns, length, choices.of_part(name), is_color=name in COLORED)

    base = header["base_degree"]
    check_int("base_degree", base, 0, MAX_DEGREE)
    means = reader.means(num, choices.means).T
    log_scales = numbers("log_scales", 2, num).T
    quats = with_w(numbers("quats", 3, num))
    logits = numbers("opacities", 1, num)[0]
    if isinstance(choices.opacities, int):
        logits = logits_of(logits)
    # Splats of an appearance with bands may have any degree up to the highest, however low the base is.
    highest = MAX_DEGREE if appearance.bands is not None else base
    table = header["degrees"]
    if not set(table) <= set(range(base, highest + 1)):
        raise ValueError(f"degrees must be in {base}..{highest}; got {table}")
    degrees = np.asarray(table, np.int64)[reader.indices("degrees", num, len(table))]
    bands = []
    for degree in range(highest + 1):
        # Band l has rows only for splats of degree l or more.
        count = int(np.count_nonzero(degrees >= degree))
        columns = numbers(f"sh_{degree}", 3, (2 * degree + 1) * count)
        bands.append(columns.reshape(3, 2 * degree + 1, count).transpose(2, 1, 0))
    sizes = texels = shapes = None
    if "sizes" in header:
        pairs = header["sizes"]
        for height, width in pairs:
            check_int("the height of a texture", height, 0, MAX_SIDE)
            check_int("the width of a texture", width, 0, MAX_SIDE)
        sizes = np.asarray(pairs, np.int64).reshape(-1, 2)[reader.indices("sizes", num, len(pairs))]
        count = int(sizes.prod(axis=1).sum())
        texels = np.concatenate([numbers("texel_colors", 3, count), numbers("texel_alphas", 1, count)]).T
    if appearance.exponents is not None:
        shapes = numbers("shapes", 1, num)[0]
        if isinstance(choices.shapes, int):
            shapes = checked_shapes(shapes)
    return Rows(means, quats, log_scales, logits, degrees, tuple(bands), sizes, texels, shapes)
