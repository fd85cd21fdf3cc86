"""Scenes for browsers, *.a2tgw: numbers rounded to bytes, most visible rows first, readable while they arrive.

docs/formats.md describes the file. N rows, in chunks of C; T texels. All numbers but positions are kept as one byte
each, positions as two; the whole body is one stream of zlib, which browsers unpack themselves.

Compact scenes (`io.compact`, *.a2tgz) are another format. This one can be drawn while it loads: a chunk holds all that
belongs to its rows, and chunks are sorted by visibility. That order and zlib cost bytes: a quarter to a fifth of the
model's numbers, where a compact scene takes a fifth to a tenth. Its precision is fixed, and textures are kept as they
are seen, so it is written for display and not for training on.
"""

import dataclasses
import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax.appearance import Appearance, TextureOptions, appearance_for, in_words
from a2tg_jax.appearance.parts import MAX_DEGREE
from a2tg_jax.core.capture_geometry import central_camera
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.host.json_text import parse_json
from a2tg_jax.io.config_json import config_from_dict
from a2tg_jax.io.model_rows import Rows, model_of, ordered, rows_of_model
from a2tg_jax.io.web_codes import codes_of, has_shapes, rows_of_body
from a2tg_jax.model import Model

MAGIC = b"a2tgw\r\n\x1a"
VERSION, SHAPED_VERSION = 1, 2
"""Versions of files without and with shapes of kernels, which readers of version 1 refuse."""
HEAD = struct.Struct("<8sHIII")
"""Magic, version, bytes of the header, bytes of the body as coded, checksum of the header."""
LARGEST_CHUNK, LEAST_CHUNK = 16384, 256
MOST_ROWS = 1 << 24
"""Largest number of rows, and of texels, that a file may announce."""
LARGEST_RATIO, FREE_ROOM = 64, 1 << 20
"""Bounds of what a file may unpack to: a multiple of its own bytes, and further bytes."""
NEAREST = 1e-3
"""Distance from a camera, in units of the median, below which a row does not count for more."""
MOST_CAMERAS = 16
"""Largest number of cameras that decide which rows show most."""


@dataclasses.dataclass(frozen=True)
class WebScene:
    """Content of a file."""

    model: Model
    """Model in float32, in the order of the file; its cameras are in the world of the scene."""
    header: Mapping[str, Any]
    """Header of the file."""


def is_viewable(appearance: Appearance) -> bool:
    """Return whether browsers can show what splats show."""
    return appearance.is_portable


def check_viewable(appearance: Appearance) -> None:
    """Raise ValueError, naming what the splats show, unless a browser can show it."""
    if not is_viewable(appearance):
        raise ValueError(
            f"the viewer cannot show {in_words(appearance)}: it shows Gaussians with or without textures, exponents "
            "and bands"
        )


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
    check_gaussians(model.gaussians, "model.gaussians")
    check_viewable(model.appearance)
    model = _as_shown(model.live)
    rows = rows_of_model(model)
    if max(len(rows.means), 0 if rows.texels is None else len(rows.texels)) > MOST_ROWS:
        raise ValueError(f"model has more Gaussians or texels than the {MOST_ROWS:,} that a web scene may hold")
    rows = ordered(rows, np.argsort(-importance(rows, model.origin), kind="stable"))
    chunk = int(np.clip(-(-len(rows.means) // 16), LEAST_CHUNK, LARGEST_CHUNK))
    codes = codes_of(rows)
    body = b"".join(piece for start in range(0, len(rows.means), chunk) for piece in codes.chunk(start, start + chunk))
    header = {
        "title": title,
        "note": note,
        "num": len(rows.means),
        "chunk": chunk,
        "base_degree": model.gaussians.sh_degree,
        "num_bands": len(rows.bands),
        "num_texels": None if rows.texels is None else len(rows.texels),
        "bytes": len(body),
        "near_plane": near_plane,
        **_appearance_to_dict(model.appearance),
        **codes.ends,
        **_origin_to_dict(model),
    }
    return _framed(header, body, level)


def decode_web_scene(data: bytes, where: str = "the web scene") -> WebScene:
    """Return the scene in the bytes of a file; errors call it `where`.

    Raises:
      ValueError: if it is not a scene for browsers, is damaged, or is of another version.
    """
    try:
        header, body = _unframed(data)
        rows = rows_of_body(header, body)
        model = model_of(rows, header["base_degree"], _appearance_of(header), _origin_of(header))
        red, green, blue = (float(number) for number in header["background"])
        return WebScene(dataclasses.replace(model, background=(red, green, blue)), header)
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{where}: the web scene is damaged or of another version ({error!r})") from error
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def importance(rows: Rows, origin: Origin | None) -> np.ndarray:
    """Return [N] opacity times the area that cameras see, on average; without cameras times the area itself."""
    shown = 1 / (1 + np.exp(-np.clip(rows.logit_opacities.astype(np.float64), -80, 80)))
    areas: np.ndarray = shown * np.exp(rows.log_scales.astype(np.float64).sum(axis=1))
    if origin is None or not len(origin.viewmats):
        return areas
    viewmats = origin.viewmats[:: -(-len(origin.viewmats) // MOST_CAMERAS)]
    centers = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    squares = np.stack([np.sum((rows.means - center) ** 2, axis=1) for center in centers])
    least = NEAREST * np.median(squares) if squares.size else 1.0
    seen: np.ndarray = areas * np.mean(1 / np.maximum(squares, max(least, 1e-30)), axis=0)
    return seen


def _as_shown(model: Model) -> Model:
    """Return the model with texels as they are seen; of their options, only the lookup remains."""
    texture = model.appearance.texture
    if texture is None or not model.num:
        return model
    seen = dataclasses.replace(texture.options, rgb="signed", alpha="projected")
    shown = dataclasses.replace(texture, texels=texture.shown(), options=seen)
    return dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=shown))


# The frame


def _framed(header: Mapping[str, Any], body: bytes, level: int) -> bytes:
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    coded = zlib.compress(body, level)
    if len(body) > _room(len(coded)):
        coded = zlib.compress(body, 0)  # So alike are its numbers that the file would be taken for a bomb.
    version = SHAPED_VERSION if has_shapes(header) else VERSION
    return HEAD.pack(MAGIC, version, len(text), len(coded), zlib.crc32(text)) + text + coded


def _room(num_coded: int) -> int:
    return FREE_ROOM + LARGEST_RATIO * num_coded


def _unframed(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header, of which the counts are checked, and the body."""
    if len(data) < HEAD.size or data[: len(MAGIC)] != MAGIC:
        raise ValueError("is not a web scene of a2tg-jax")
    _, version, num_text, num_coded, checksum = HEAD.unpack_from(data)
    if version not in (VERSION, SHAPED_VERSION):
        versions = f"{VERSION} and {SHAPED_VERSION}"
        raise ValueError(f"is a web scene of version {version}; this program reads versions {versions}")
    if len(data) != HEAD.size + num_text + num_coded:
        raise ValueError(f"has {len(data)} bytes where {HEAD.size + num_text + num_coded} are announced")
    text = data[HEAD.size : HEAD.size + num_text]
    if zlib.crc32(text) != checksum:
        raise ValueError("is damaged: the checksum of its header differs")
    header = parse_json(text)
    _check_counts(header, num_coded)
    reader = zlib.decompressobj()
    try:
        body = reader.decompress(data[HEAD.size + num_text :], header["bytes"] + 1)
    except zlib.error as error:
        raise ValueError(f"is damaged: {error}") from error
    if len(body) != header["bytes"] or not reader.eof:
        raise ValueError(f"does not unpack to the announced {header['bytes']} bytes")
    return header, body


def _check_counts(header: object, num_coded: int) -> None:
    """Raise ValueError unless no more is announced than such a file can hold."""
    if not isinstance(header, dict):
        raise ValueError("has no header")
    texels = 0 if header["num_texels"] is None else header["num_texels"]
    limits = {"num": (0, MOST_ROWS), "chunk": (1, MOST_ROWS), "bytes": (0, _room(num_coded))}
    limits |= {"base_degree": (0, MAX_DEGREE), "num_bands": (1, MAX_DEGREE + 1)}
    for name, (least, most) in limits.items():
        if type(header[name]) is not int or not least <= header[name] <= most:
            raise ValueError(f"announces {name} {header[name]!r}; {least} to {most} are possible")
    if type(texels) is not int or not 0 <= texels <= MOST_ROWS:
        raise ValueError(f"announces num_texels {texels!r}; 0 to {MOST_ROWS} are possible")
    if header["bytes"] < 16 * header["num"] + 4 * texels:
        raise ValueError(f"announces {header['num']} rows and {texels} texels in {header['bytes']} bytes")


# What stands in the header as text


def _appearance_to_dict(appearance: Appearance) -> dict[str, Any]:
    options = appearance.texture_options or TextureOptions()
    return {
        "banded": appearance.bands is not None,
        "uv": options.uv,
        "outside": options.outside,
        "max_alpha": appearance.alpha_limit,
    }


def _appearance_of(header: Mapping[str, Any]) -> Appearance:
    """Return the appearance that a file describes."""
    max_alpha = header["max_alpha"]
    if not isinstance(max_alpha, float) or not 0 < max_alpha < 1:
        raise ValueError(f"max_alpha must lie in (0, 1); got {max_alpha!r}")
    has_textures = header["num_texels"] is not None
    named = {"uv": header["uv"], "outside": header["outside"]} if has_textures else {}
    options = config_from_dict(TextureOptions, {**named, "max_alpha": max_alpha}, "options")
    return appearance_for(
        options, has_textures=has_textures, has_degrees=header["banded"] is True, has_shapes=has_shapes(header)
    )


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
    return {"background": as_floats(model.background), "cameras": cameras, "first": _first_camera(origin)}


def _first_camera(origin: Origin) -> int:
    """Return the index of the camera at which the viewer opens: the most central one of the training cameras."""
    candidates = np.flatnonzero(~origin.is_test) if not np.all(origin.is_test) else np.arange(len(origin.is_test))
    return int(candidates[central_camera(origin.viewmats[candidates])]) if len(candidates) else 0


def _origin_of(header: Mapping[str, Any]) -> Origin | None:
    """Return the cameras, in the world of the scene; None without cameras."""
    cameras = header["cameras"]
    if cameras is None:
        return None
    return Origin(
        viewmats=np.array([camera["viewmat"] for camera in cameras], np.float64).reshape(-1, 4, 4),
        Ks=np.array([camera["K"] for camera in cameras], np.float64).reshape(-1, 3, 3),
        sizes=np.array([camera["size"] for camera in cameras], np.int64).reshape(-1, 2),
        names=tuple(str(camera["name"]) for camera in cameras),
        is_test=np.array([camera["is_test"] for camera in cameras], bool),
        transform=Similarity(1.0, np.eye(3), np.zeros(3)),
    )
