"""Scenes for browsers, *.a2tgw: numbers rounded to bytes, most visible rows first, readable while they arrive.

docs/formats.md describes the file. N rows, in chunks of C; T texels. All numbers but positions are kept as one byte
each, positions as two; the whole body is one stream of zlib, which browsers unpack themselves. This program writes such
files; browsers read them (web/src/decode.ts).

Compact scenes (`io.compact`, *.a2tgz) are another format. This one can be drawn while it loads: a chunk holds all that
belongs to its rows, and chunks are sorted by visibility. That order and zlib cost bytes: a quarter to a fifth of the
model's numbers, where a compact scene takes a fifth to a tenth. Its precision is fixed, and textures are kept as they
are seen, so it is written for display and not for training on. Columns come first: [C, N].
"""

import dataclasses
import json
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax.appearance import TextureOptions, in_words
from a2tg_jax.appearance.parts import log_exponents_of, shapes_of
from a2tg_jax.core.camera_paths import central_camera
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.io.columns import (
    AxisSteps,
    dequantised,
    ends_of,
    logits_of,
    opacities_of,
    quantised,
    room_of,
    to_planes,
    with_green,
    with_w,
)
from a2tg_jax.io.model_rows import Rows, model_of, ordered, rows_of_model
from a2tg_jax.model import Model

MAGIC = b"a2tgw\r\n\x1a"
VERSION, SHAPED_VERSION = 1, 2
"""Versions of files without and with shapes of kernels, which readers of version 1 refuse."""
HEAD = struct.Struct("<8sHIII")
"""Magic, version, bytes of the header, bytes of the body as coded, checksum of the header."""
LARGEST_CHUNK, LEAST_CHUNK = 16384, 256
MOST_ROWS = 1 << 24
"""Largest number of rows, and of texels, that readers take."""
MEANS_BITS = 16
BITS: Mapping[str, int] = {
    "log_scales": 8, "quats": 8, "opacities": 8, "sh_0": 8, "sh_1": 7, "sh_2": 6, "sh_3": 6, "colors": 8, "alphas": 8,
    "shapes": 8,
}  # fmt: skip
"""Bits of the numbers kept as a byte."""
SCALE_RANGE = 16.0
"""Largest −log of a scale relative to the largest one; smaller scales, below a pixel in any full view, are raised."""
NEAREST = 1e-3
"""Distance from a camera, in units of the median, below which a row does not count for more."""
MOST_CAMERAS = 16
"""Largest number of cameras that decide which rows show most."""


def encode_web_scene(
    model: Model, *, title: str = "", note: str = "", near_plane: float = 0.2, level: int = 9
) -> bytes:
    """Return the bytes of a file.

    Args:
      model: of Gaussians with or without textures, exponents and bands.
      title: what the page is called.
      note: what the viewer says about the scene.
      near_plane: hits nearer than this do not show.
      level: of zlib, 1 quickest to 9 smallest.

    Raises:
      ValueError: if the model shows anything else, has more rows than a file may hold, or a number that is not finite.
    """
    model, rows = _shown(model)
    steps, tables = _coded(rows)
    # A chunk has the columns of its rows from each table; a row of the scene owns one column, several or none.
    num = len(rows.means)
    chunk = int(np.clip(-(-num // 16), LEAST_CHUNK, LARGEST_CHUNK))
    cut = [(codes.astype(np.uint8), np.concatenate([[0], np.cumsum(counts)])) for codes, counts in tables]
    body = b"".join(
        codes[:, places[start] : places[min(start + chunk, num)]].tobytes()
        for start in range(0, num, chunk)
        for codes, places in cut
    )
    options = model.appearance.texture_options or TextureOptions()
    header = {
        "title": title,
        "note": note,
        "num": num,
        "chunk": chunk,
        "base_degree": model.gaussians.sh_degree,
        "num_bands": len(rows.bands),
        "num_texels": None if rows.texels is None else len(rows.texels),
        "bytes": len(body),
        "near_plane": near_plane,
        "banded": model.appearance.bands is not None,
        "uv": options.uv,
        "outside": options.outside,
        "max_alpha": model.appearance.alpha_limit,
        **steps,
        **_origin_to_dict(model),
    }
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    coded = zlib.compress(body, level)
    if len(body) > room_of(len(coded)):
        coded = zlib.compress(body, 0)  # So alike are its numbers that the file would be taken for a bomb.
    version = VERSION if rows.shapes is None else SHAPED_VERSION
    return HEAD.pack(MAGIC, version, len(text), len(coded), zlib.crc32(text)) + text + coded


def rounded_model(model: Model) -> Model:
    """Return the model that browsers show, float32: its numbers as a file holds them, in the order of the file.

    Args:
      model: as in `encode_web_scene`. Raises as it does.
    """
    model, rows = _shown(model)
    rounded: dict[str, np.ndarray] = {}
    _coded(rows, rounded.__setitem__)
    bands = tuple(
        rounded[f"sh_{degree}"].reshape(3, 2 * degree + 1, -1).transpose(2, 1, 0) for degree in range(len(rows.bands))
    )
    texels = None
    if rows.texels is not None:
        texels = np.concatenate([rounded["colors"] * np.abs(rounded["colors"]), rounded["alphas"]]).T
    rows = dataclasses.replace(
        rows,
        means=rounded["means"].T,
        quats=with_w(rounded["quats"]),
        log_scales=rounded["log_scales"].T,
        logit_opacities=logits_of(rounded["opacities"][0]),
        bands=bands,
        texels=texels,
        shapes=None if rows.shapes is None else shapes_of(rounded["shapes"][0]),
    )
    return model_of(rows, model.gaussians.sh_degree, model.appearance, model.origin, model.background)


def _shown(model: Model) -> tuple[Model, Rows]:
    """Return a model with texels as they are seen, of whose options only the lookup remains, and its rows in order."""
    check_gaussians(model.gaussians, "model.gaussians")
    if not model.appearance.is_portable:
        raise ValueError(
            f"the viewer cannot show {in_words(model.appearance)}: it shows Gaussians with or without textures, "
            "exponents and bands"
        )
    model = model.live
    texture = model.appearance.texture
    if texture is not None and model.num:
        seen = dataclasses.replace(texture.options, rgb="signed", alpha="projected")
        texture = dataclasses.replace(texture, texels=texture.shown(), options=seen)
        model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=texture))
    rows = rows_of_model(model)
    if max(len(rows.means), 0 if rows.texels is None else len(rows.texels)) > MOST_ROWS:
        raise ValueError(f"model has more Gaussians or texels than the {MOST_ROWS:,} that a web scene may hold")
    return model, ordered(rows, np.argsort(-importance(rows, model.origin), kind="stable"))


def _coded(
    rows: Rows, keep: Callable[[str, np.ndarray], None] = lambda name, values: None
) -> tuple[dict[str, Any], list[tuple[np.ndarray, np.ndarray]]]:
    """Return numbers as bytes.

    Args:
      rows: the rows in order.
      keep: is called with the name and the rounded numbers of each group.

    Returns:
      The first and last steps of all numbers, for the header; and tables of bytes in the order of docs/formats.md, each
      with the number [N] of its columns that belong to each row.
    """
    ends: dict[str, list[float]] = {}

    def coded(name: str, values: np.ndarray, is_color: bool = False) -> np.ndarray:
        found = ends_of(values, BITS[name])
        ends[name] = list(found)
        codes = quantised(values, found, BITS[name])
        keep(name, dequantised(codes, found, BITS[name]))
        return with_green(codes, BITS[name], -1) if is_color else codes

    axes = [AxisSteps.of(x, MEANS_BITS) for x in rows.means.T]
    means = np.stack([axis.codes(x, MEANS_BITS) for axis, x in zip(axes, rows.means.T, strict=True)])
    keep("means", np.stack([axis.values(codes, MEANS_BITS) for axis, codes in zip(axes, means, strict=True)]))
    columns = [
        coded("log_scales", np.maximum(rows.log_scales, rows.log_scales.max(initial=-np.inf) - SCALE_RANGE).T),
        coded("quats", rows.quats[:, 1:].T),
        coded("opacities", opacities_of(rows.logit_opacities)[None]),
        coded("sh_0", rows.bands[0][:, 0].T, is_color=True),
        rows.degrees[None],
    ]
    bands = []
    for degree, band in enumerate(rows.bands[1:], 1):
        flat = coded(f"sh_{degree}", band.transpose(2, 1, 0).reshape(3, -1), is_color=True)
        bands.append((flat.reshape(3 * (2 * degree + 1), len(band)), rows.degrees >= degree))
    texels = []
    if rows.sizes is not None and rows.texels is not None:
        # Signed square roots, so that steps grow with the residual: most residuals are small.
        residuals = rows.texels[:, :3].T
        colors = coded("colors", np.sign(residuals) * np.sqrt(np.abs(residuals)), is_color=True)
        texels = [(np.concatenate([colors, coded("alphas", rows.texels[:, 3:].T)]), rows.sizes.prod(axis=1))]
        columns.append(rows.sizes.T)
    if rows.shapes is not None:
        columns.append(coded("shapes", log_exponents_of(rows.shapes)[None]))
    ones = np.ones(len(rows.means), np.int64)
    tables = [(to_planes(means, MEANS_BITS), ones), *((codes, ones) for codes in columns), *bands, *texels]
    return {"means": [list(axis) for axis in axes], "ends": ends}, tables


def importance(rows: Rows, origin: Origin | None) -> np.ndarray:
    """Return [N] opacity times the area that cameras see, on average; without cameras times the area itself."""
    areas: np.ndarray = opacities_of(rows.logit_opacities) * np.exp(rows.log_scales.astype(np.float64).sum(axis=1))
    if origin is None or not len(origin.viewmats):
        return areas
    viewmats = origin.viewmats[:: -(-len(origin.viewmats) // MOST_CAMERAS)]  # Evenly chosen.
    centers = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    squares = np.stack([np.sum((rows.means - center) ** 2, axis=1) for center in centers])
    least = NEAREST * np.median(squares) if squares.size else 1.0
    return areas * np.mean(1 / np.maximum(squares, max(least, 1e-30)), axis=0)


def _origin_to_dict(model: Model) -> dict[str, Any]:
    origin = model.origin
    if origin is None:
        return {"background": list(model.background), "cameras": None}

    def as_floats(x: ArrayLike) -> list[float]:
        return [float(str(number)) for number in np.asarray(x, np.float32).ravel()]

    cameras = [
        {
            "name": name,
            "is_test": bool(is_test),
            "size": size.tolist(),
            "viewmat": as_floats(viewmat),
            "K": as_floats(K),
        }
        for name, is_test, size, viewmat, K in zip(
            origin.names, origin.is_test, origin.sizes, origin.viewmats, origin.Ks, strict=True
        )
    ]
    # The viewer opens at the most central one of the training cameras.
    candidates = np.flatnonzero(~origin.is_test) if not np.all(origin.is_test) else np.arange(len(origin.is_test))
    first = int(candidates[central_camera(origin.viewmats[candidates])]) if len(candidates) else 0
    return {"background": as_floats(model.background), "cameras": cameras, "first": first}
