"""Compact scene files, *.a2tgz: a model in few bytes, with a chosen number of bits for each group of numbers.

docs/formats.md describes the file. Rows come back in the order of a Z curve through the means, with quaternions of unit
length; the model shows the same up to rounding.

Files for browsers (`io.web_scene`, *.a2tgw) are another format. This one is smaller: it sorts rows by place, codes each
group of numbers as a whole with LZMA, zstd or WebP, and restores the model with its appearance, origin and float64
cameras. It must be read to its end before anything can be drawn, and browsers have no decoder for LZMA. Both share the
steps and planes of `io.columns` and the tables of `io.model_rows`.
"""

import dataclasses
import json
import os
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.parts import MAX_DEGREE, log_exponents_of, shapes_of
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import parse_json
from a2tg_jax.io.columns import (
    Choice,
    ColumnReader,
    ColumnWriter,
    Precision,
    check_precision,
    decode,
    encode,
    logits_of,
    opacities_of,
    room_of,
    with_w,
)
from a2tg_jax.io.config_json import config_from_dict, config_to_dict
from a2tg_jax.io.model_file import (
    appearance_from_dict,
    appearance_to_dict,
    background_of,
    origin_arrays,
    origin_of,
    origin_shapes,
)
from a2tg_jax.io.model_rows import Rows, check_encodable, model_of, ordered, rows_of_model
from a2tg_jax.io.validate import check_suffix, existing_bytes, reading
from a2tg_jax.model import Model, check_is_model
from a2tg_jax.texture import MAX_SIDE

MAGIC = b"a2tgz\r\n\x1a"
VERSION, SHAPED_VERSION = 1, 2
"""Versions of files without and with shapes of kernels, which readers of version 1 refuse."""
HEAD = struct.Struct("<8sHIII")
"""Magic, version, bytes of the header as coded and as text, checksum of all that follows."""
ORIGIN_DTYPES = {
    "viewmats": "f8", "Ks": "f8", "sizes": "i4", "is_test": "u1", "scale": "f8", "rotation": "f8", "translation": "f8",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class CompactChoices:
    """Precision of each group of numbers: 1 to 16 bits, in even steps from the smallest to the largest, or floats.

    The defaults cost a few hundredths of a decibel.
    """

    means: Precision = 14
    """Precision of each axis; bits have steps that grow with the distance from the middle."""
    log_scales: Precision = 8
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
    """Coder of all parts: lzma (Python's own), zstd, webp (lossless images), none, or the smallest for each part."""

    def keeping(self, others: Mapping[str, Any]) -> Self:
        """Return the choices with some changed, by name."""
        return dataclasses.replace(self, **dict(others))

    def of_part(self, name: str) -> Precision:
        """Return the precision of a part of the file, such as sh_2 or texel_colors."""
        groups = {"sh_0": "sh_0", "texel_colors": "texels", "texel_alphas": "texels"}
        group = groups.get(name, "sh_rest" if name.startswith("sh_") else name)
        return getattr(self, group)

    def check(self) -> Self:
        """Raise ValueError, naming the choice, if one is invalid."""
        for field in dataclasses.fields(self):
            if field.name != "coder":
                check_precision(f"choices.{field.name}", getattr(self, field.name))
        config_from_dict(type(self), config_to_dict(self), "choices")
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
    """Write a model's live rows, its appearance and its origin in few bytes.

    Args:
      path: the file, by custom *.a2tgz; an older one is replaced once the new one is whole.
      model: of Gaussians with or without textures, exponents and bands.
      choices: how finely its numbers are kept.
      grids: grids of the groups kept in bits, with which the model was tuned (`tune_compact`); None: those between the
        smallest and the largest of the model's own numbers.

    Raises:
      ValueError: if the model shows anything else, has a number that is not finite or too large, or a
        choice cannot be.
    """
    check_suffix(path, "save_compact")
    check_is_model(model)
    data = encode_model(model, choices, grids)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def load_compact(path: str | os.PathLike[str]) -> Model:
    """Return the model of a compact file, float32, its rows in the order of the file.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a compact scene, is damaged, or is of another version.
    """
    check_suffix(path, "load_compact")
    return decode_model(existing_bytes(path, "compact scene"), os.fspath(path))


def encode_model(model: Model, choices: CompactChoices = DEFAULT_CHOICES, grids: Grids | None = None) -> bytes:
    """Return the bytes of `save_compact`. Raises as it does.

    Args:
      model: as there; with grids as `half_turned` gives it, with numbers that may have changed since.
      choices: as there.
      grids: as there (`grids_of`); numbers beyond their ends are cut to them.
    """
    choices.check()
    check_gaussians(model.gaussians, "model.gaussians")
    check_encodable(model.appearance)
    data, num_unpacked = _encoded(model.live, choices, grids)
    if num_unpacked > room_of(len(data)):  # So alike are its numbers that the file would be taken for a bomb.
        data, _ = _encoded(model.live, dataclasses.replace(choices, coder="none"), grids)
    return data


def half_turned(model: Model) -> Model:
    """Return the model that its file without rounding holds: its rows along a Z curve, and splats half-turned."""
    exact = CompactChoices(coder="none").keeping(dict.fromkeys(GROUPS, "float32"))
    return decode_model(encode_model(model, exact))


def grids_of(model: Model, choices: CompactChoices) -> Grids:
    """Return the grids of a file of these choices, for each group kept in bits of which the model has numbers."""
    header, _ = _unframed(encode_model(model, dataclasses.replace(choices, coder="none")))
    return {name: tuple(ends) for name, ends in header["ends"].items()}


def decode_model(data: bytes, where: str = "the compact scene") -> Model:
    """Return the model of the bytes of a file; errors call it `where`. Raises as `load_compact` does."""
    with reading(where):
        header, body = _unframed(data)
        choices = config_from_dict(CompactChoices, header["choices"], "choices").check()
        appearance = appearance_from_dict(header["appearance"])
        check_encodable(appearance)
        reader = ColumnReader(body, header, room_of(len(data)))
        rows = _rows_of(reader, header, choices, appearance)
        origin = None
        if "origin" in header:
            shapes = origin_shapes(len(header["origin"]["names"]))
            arrays = {
                name: reader.exact(f"origin_{name}", shape, ORIGIN_DTYPES[name]) for name, shape in shapes.items()
            }
            origin = origin_of(header["origin"], arrays | {"is_test": arrays["is_test"].astype(bool)})
        reader.end()
        return model_of(rows, header["base_degree"], appearance, origin, background_of(header))


def bytes_by_part(data: bytes) -> dict[str, int]:
    """Return how many bytes each part of a whole file takes, the header included."""
    header, body = _unframed(data)
    return {"header": len(data) - len(body), **header["lengths"]}


# From a model to bytes


def _encoded(model: Model, choices: CompactChoices, grids: Grids | None) -> tuple[bytes, int]:
    """Return the file, and how many bytes it unpacks to."""
    writer, rows = ColumnWriter(choices.coder, grids or {}), rows_of_model(model)
    rows = ordered(rows, writer.means("means", rows.means.T, choices.means), turns=grids is None)
    writer.numbers("log_scales", rows.log_scales.T, choices.log_scales)
    writer.numbers("quats", rows.quats[:, 1:].T, choices.quats)
    opacities = opacities_of(rows.logit_opacities) if isinstance(choices.opacities, int) else rows.logit_opacities
    writer.numbers("opacities", opacities[None], choices.opacities)
    degrees = np.unique(rows.degrees)
    writer.indices("degrees", np.searchsorted(degrees, rows.degrees), len(degrees))
    for degree, band in enumerate(rows.bands):
        name, columns = f"sh_{degree}", band.transpose(2, 1, 0).reshape(3, -1)
        writer.numbers(name, columns, choices.of_part(name), is_color=True)
    header: dict[str, Any] = {
        "num": len(rows.means),
        "base_degree": model.gaussians.sh_degree,
        "degrees": degrees.tolist(),
        "choices": config_to_dict(choices),
        "appearance": appearance_to_dict(model.appearance),
    }
    if rows.sizes is not None and rows.texels is not None:
        sizes, indices = np.unique(rows.sizes, axis=0, return_inverse=True)
        header["sizes"] = sizes.tolist()
        writer.indices("sizes", indices.reshape(-1), len(sizes))
        writer.numbers("texel_colors", rows.texels[:, :3].T, choices.texels, is_color=True)
        writer.numbers("texel_alphas", rows.texels[:, 3:].T, choices.texels)
    if rows.shapes is None:
        del header["choices"]["shapes"]
    else:
        is_bits = isinstance(choices.shapes, int)
        writer.numbers("shapes", (log_exponents_of(rows.shapes) if is_bits else rows.shapes)[None], choices.shapes)
    header["background"] = list(model.background)
    if model.origin is not None:
        header["origin"] = {"names": list(model.origin.names)}
        for name, array in origin_arrays(model.origin).items():
            writer.exact(f"origin_{name}", np.asarray(array, ORIGIN_DTYPES[name]))
    version = VERSION if rows.shapes is None else SHAPED_VERSION
    return _framed(header | writer.layout, writer.body, version), writer.num_unpacked


def _framed(header: Mapping[str, object], body: bytes, version: int = VERSION) -> bytes:
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    coded = encode("zstd", np.frombuffer(text, np.uint8)[None])
    rest = coded + body
    return HEAD.pack(MAGIC, version, len(coded), len(text), zlib.crc32(rest)) + rest


# From bytes to a model


def _unframed(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header and the body of a whole file."""
    if len(data) < HEAD.size or data[: len(MAGIC)] != MAGIC:
        raise ValueError("is not a compact scene of a2tg-jax")
    _, version, num_coded, num_text, checksum = HEAD.unpack_from(data)
    if version not in (VERSION, SHAPED_VERSION):
        versions = f"{VERSION} and {SHAPED_VERSION}"
        raise ValueError(f"is a compact scene of version {version}; this program reads versions {versions}")
    rest = data[HEAD.size :]
    if zlib.crc32(rest) != checksum:
        raise ValueError("is damaged or cut off")
    if num_coded > len(rest) or num_text > room_of(len(data)):
        raise ValueError(f"announces a header of {num_coded} bytes, {num_text} unpacked")
    header = parse_json(decode("zstd", rest[:num_coded], 1, num_text).tobytes())
    if not isinstance(header, dict):
        raise ValueError("has no header")
    return header, rest[num_coded:]


def _rows_of(reader: ColumnReader, header: Mapping[str, Any], choices: CompactChoices, appearance: Appearance) -> Rows:
    """Return the tables of a file, of no more rows than it can hold."""
    num, base, table = header["num"], header["base_degree"], header["degrees"]
    if type(num) is not int or num < 0 or type(base) is not int or not 0 <= base <= MAX_DEGREE:
        raise ValueError(f"must be of a number of rows, and of a base degree in 0..3; got {num!r}, {base!r}")
    means = reader.means("means", num, choices.means).T
    log_scales = reader.numbers("log_scales", 2, num, choices.log_scales).T
    quats = with_w(reader.numbers("quats", 3, num, choices.quats))
    opacities = reader.numbers("opacities", 1, num, choices.opacities)[0]
    highest = MAX_DEGREE if appearance.bands is not None else base
    if not set(table) <= set(range(base, highest + 1)):
        raise ValueError(f"degrees must lie in {base}..{highest}; got {table}")
    degrees = np.asarray(table, np.int64)[reader.indices("degrees", num, len(table))]
    bands = []
    for degree in range(highest + 1):
        count = int(np.count_nonzero(degrees >= degree))
        name = f"sh_{degree}"
        columns = reader.numbers(name, 3, (2 * degree + 1) * count, choices.of_part(name), is_color=True)
        bands.append(columns.reshape(3, 2 * degree + 1, count).transpose(2, 1, 0))
    sizes, texels = None, None
    if "sizes" in header:
        pairs = header["sizes"]
        if not all(type(side) is int and 0 <= side <= MAX_SIDE for size in pairs for side in size):
            raise ValueError(f"texture sides must lie in 0..{MAX_SIDE}; got {pairs}")
        if any(len(size) != 2 for size in pairs):
            raise ValueError(f"texture sides must be pairs; got {pairs}")
        sizes = np.asarray(pairs, np.int64).reshape(-1, 2)[reader.indices("sizes", num, len(pairs))]
        count = int(sizes.prod(axis=1).sum())
        colors = reader.numbers("texel_colors", 3, count, choices.texels, is_color=True)
        texels = np.concatenate([colors, reader.numbers("texel_alphas", 1, count, choices.texels)]).T
    shapes = None
    if appearance.exponents is not None:
        shapes = reader.numbers("shapes", 1, num, choices.shapes)[0]
        shapes = shapes_of(shapes) if isinstance(choices.shapes, int) else shapes
    logits = logits_of(opacities) if isinstance(choices.opacities, int) else opacities
    return Rows(means, quats, log_scales, logits, degrees, tuple(bands), sizes, texels, shapes)
