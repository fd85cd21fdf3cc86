"""The extension A2TG_splat_textures of glTF: textures, degrees and kernels of splats beside KHR_gaussian_splatting.

docs/formats.md describes it. Programs that do not know it show the plain splats.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from a2tg_jax.appearance import Appearance, TextureOptions, appearance_for
from a2tg_jax.appearance.parts import EXTENT, MAX_DEGREE, log_exponents_of, shapes_of
from a2tg_jax.host.text import shortened
from a2tg_jax.io.config_json import config_from_dict
from a2tg_jax.io.gltf_reader import Document
from a2tg_jax.io.gltf_writer import Builder
from a2tg_jax.io.model_file import appearance_from_dict
from a2tg_jax.io.model_rows import Rows
from a2tg_jax.io.quantise import LARGEST_FLOAT, Ends, dequantised, ends_of, quantised
from a2tg_jax.texture import MAX_SIDE

EXTENSION = "A2TG_splat_textures"
TexelKind = Literal["float32", "uint8"]
OPTIONS = {"uv": "uv", "outside": "outside", "rgb": "rgb", "alpha": "alpha", "maxAlpha": "max_alpha"}
"""Names of the options that say how textures are shown, and their fields."""
RANGES = {"rgb": slice(0, 3), "alpha": slice(3, 4)}
"""Columns of texels that share ends."""


class SplatTextures(NamedTuple):
    """Textures, degrees and kernels of splats, beside their own colours."""

    appearance: Appearance
    sizes: np.ndarray | None
    """Sizes [N, 2] of the textures, (Tv, Tu)."""
    texels: np.ndarray | None
    """Texels [T, 4], one texture after the other, each row by row."""
    degrees: np.ndarray | None
    """Degrees [N] of the spherical harmonics."""
    base_degree: int
    """Degree that all splats have."""
    shapes: np.ndarray | None
    """Shapes [N] of the kernels."""


def add_textures(
    builder: Builder, rows: Rows, appearance: Appearance, base_degree: int, kind: TexelKind
) -> dict[str, Any]:
    """Add what splats show to a file, and return the object of the extension; an empty one if it is nothing."""
    described: dict[str, Any] = {}
    options = appearance.texture_options
    if options is not None and rows.sizes is not None and rows.texels is not None:
        described |= {"extent": EXTENT} | {name: getattr(options, field) for name, field in OPTIONS.items()}
        described["sizes"] = builder.add(rows.sizes.astype(np.uint8), is_attribute=False)
        if len(rows.texels):
            described |= _add_texels(builder, rows.texels, kind)
    if appearance.bands is not None:
        described["baseDegree"] = base_degree
        described["degrees"] = builder.add(rows.degrees.astype(np.uint8), is_attribute=False)
    if rows.shapes is not None:
        described["shapes"] = builder.add(log_exponents_of(rows.shapes).astype(np.float32), is_attribute=False)
    if described:
        described["maxAlpha"] = appearance.alpha_limit
    return described


def _add_texels(builder: Builder, texels: np.ndarray, kind: TexelKind) -> dict[str, Any]:
    if kind == "float32":
        return {"texels": builder.add(texels.astype(np.float32), is_attribute=False)}
    ranges = {name: ends_of(texels[:, columns], 8) for name, columns in RANGES.items()}
    codes = [quantised(texels[:, columns], ranges[name], 8) for name, columns in RANGES.items()]
    index = builder.add(np.concatenate(codes, axis=1).astype(np.uint8), normalized=True, is_attribute=False)
    return {"texels": index, "texelRanges": {name: list(ends) for name, ends in ranges.items()}}


def shown_of(document: Document, described: Mapping[str, Any], num: int, sh_degree: int) -> SplatTextures:
    """Return what `num` splats show, from the object of the extension.

    Raises:
      ValueError: if a field is missing, out of range, or does not fit the others.
    """
    has_textures, has_degrees, has_shapes = (name in described for name in ("sizes", "degrees", "shapes"))
    names = {field: described[name] for name, field in OPTIONS.items() if name in described}
    options = config_from_dict(TextureOptions, names, EXTENSION)
    if not 0 < options.max_alpha < 1:
        raise ValueError(f"{EXTENSION}.maxAlpha must lie in (0, 1); got {options.max_alpha!r}")
    appearance = appearance_for(options, has_textures=has_textures, has_degrees=has_degrees, has_shapes=has_shapes)
    sizes, texels = _textures(document, described, num) if has_textures else (None, None)
    degrees, base = _degrees(document, described, num, sh_degree) if has_degrees else (None, sh_degree)
    shapes = _shapes(document, described["shapes"], num) if has_shapes else None
    return SplatTextures(appearance, sizes, texels, degrees, base, shapes)


def _textures(document: Document, described: Mapping[str, Any], num: int) -> tuple[np.ndarray, np.ndarray]:
    if described.get("extent", EXTENT) != EXTENT:
        raise ValueError(f"{EXTENSION}.extent must be {EXTENT}; got {shortened(described['extent'])}")
    sizes = _integers(document, described["sizes"], "VEC2", "sizes", num, MAX_SIDE)
    count = int(sizes.prod(axis=1).sum())
    texels = np.zeros((0, 4), np.float32)
    if "texels" in described:
        texels = document.numbers(described["texels"], ("VEC4",), f"{EXTENSION}.texels")
    if len(texels) != count:
        raise ValueError(f"{EXTENSION}.sizes are of {count} texels, but there are {len(texels)}")
    for name, columns in RANGES.items() if "texelRanges" in described else ():
        low, high = described["texelRanges"][name]
        if not all(type(end) in (int, float) and abs(end) <= LARGEST_FLOAT for end in (low, high)):
            raise ValueError(f"{EXTENSION}.texelRanges.{name} must be two numbers")
        texels[:, columns] = dequantised(texels[:, columns] * 255.0, Ends(low, high), 8)
    return sizes, texels


def _degrees(document: Document, described: Mapping[str, Any], num: int, sh_degree: int) -> tuple[np.ndarray, int]:
    degrees = _integers(document, described["degrees"], "SCALAR", "degrees", num, MAX_DEGREE)[:, 0]
    base = described["baseDegree"]
    least, most = int(degrees.min(initial=sh_degree)), int(degrees.max(initial=0))
    if type(base) is not int or not 0 <= base <= least or most > sh_degree:
        raise ValueError(
            f"{EXTENSION}.degrees must lie from baseDegree to the {sh_degree} of the splats; got {least}..{most} and "
            f"{shortened(base)}"
        )
    return degrees, base


def _shapes(document: Document, index: Any, num: int) -> np.ndarray:
    log_exponents = document.numbers(index, ("SCALAR",), f"{EXTENSION}.shapes")[:, 0]
    if len(log_exponents) != num:
        raise ValueError(f"{EXTENSION}.shapes must be {num} numbers; got {len(log_exponents)}")
    return shapes_of(log_exponents)


def _integers(document: Document, index: Any, kind: str, name: str, num: int, most: int) -> np.ndarray:
    """Return the integers [num, columns] of an accessor."""
    values = document.numbers(index, (kind,), f"{EXTENSION}.{name}")
    if len(values) != num or not ((values >= 0) & (values <= most) & (values % 1 == 0)).all():
        raise ValueError(f"{EXTENSION}.{name} must be {num} times whole numbers in 0..{most}")
    return values.astype(np.int64)


def kept_appearance(kept: Mapping[str, Any], shown: Appearance, *, is_told: bool) -> Appearance:
    """Return the appearance that a model had, with options of its training, if it shows the same.

    Args:
      kept: what the extras keep.
      shown: what the file says without these.
      is_told: the file says more than that there are no textures.
    """
    if "appearance" not in kept:
        return shown
    appearance = appearance_from_dict(kept["appearance"], ())
    own, told = appearance.texture_options, shown.texture_options
    is_same = appearance.is_portable and (own is None) == (told is None)
    is_same &= (appearance.bands is None, appearance.exponents is None) == (
        shown.bands is None,
        shown.exponents is None,
    )
    if is_same and is_told:
        is_same = appearance.alpha_limit == shown.alpha_limit and all(
            getattr(own, field, None) == getattr(told, field, None) for field in ("uv", "outside", "rgb", "alpha")
        )
    return appearance if is_same else shown
