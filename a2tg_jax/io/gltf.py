"""glTF files of splats: KHR_gaussian_splatting, as *.glb, or *.gltf with a *.bin.

Splats are points of a mesh: means, rotations, scales, opacities and spherical harmonics are its attributes. They stay
in the model's world; their node's matrix maps it to glTF's world, which has +y up. Textures, degrees and kernels are in
the extension A2TG_splat_textures; programs without it show plain splats. docs/formats.md describes both.
"""

import os
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np

from a2tg_jax import Appearance, Bands, Exponents, Model, Texture, TextureOptions
from a2tg_jax.appearance.parts import MAX_DEGREE
from a2tg_jax.base.checks import check_int, check_literal
from a2tg_jax.base.config_json import config_from_dict
from a2tg_jax.base.json_text import number_array
from a2tg_jax.base.regular_files import reading
from a2tg_jax.base.suffixes import checked_path
from a2tg_jax.base.text import shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.sh import NUM_BASES, SH_C0
from a2tg_jax.io.columns import Ends, checked_shapes, dequantised, ends_of, log_exponents_of, quantised
from a2tg_jax.io.gltf_container import Builder, Document, mesh_nodes, scene_of_one
from a2tg_jax.io.model_rows import Rows, check_encodable, columns_of, model_of, rows_of_model
from a2tg_jax.io.other_programs import (
    Ellipsoids,
    degree_to_read,
    gaussians_of,
    joined_parts,
    linear_colors,
    matrix_of,
    model_of_splats,
    origin_to_json,
    splats_of,
    to_bytes,
    upright,
)
from a2tg_jax.io.spz import GLTF_AXES, decode_spz
from a2tg_jax.model import checked_live
from a2tg_jax.model_file import appearance_from_dict, appearance_to_dict, background_of, origin_of
from a2tg_jax.texture import MAX_SIDE

SPLATS = "KHR_gaussian_splatting"
EXTENSION = "A2TG_splat_textures"
SPZ = (
    f"{SPLATS}_compression_spz_2", f"{SPLATS}_compression_spz", "KHR_spz_gaussian_splats_compression",
)  # fmt: skip
"""Drafts of an extension whose bufferView is an SPZ file: inside `SPLATS`, the last one instead of it."""
READ = {SPLATS, EXTENSION, *SPZ, "KHR_mesh_quantization", "KHR_materials_unlit"}
"""Extensions that a file may require."""
MEANS = "POSITION"
ROTATION = f"{SPLATS}:ROTATION"
SCALE = f"{SPLATS}:SCALE"
OPACITY = f"{SPLATS}:OPACITY"
DESCRIBED = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
OWN = "a2tg"
"""Key in the extras of splats for what belongs to their model."""
TexelKind = Literal["float32", "uint8"]
OPTIONS = {
    "extent": "extent",
    "uv": "uv",
    "outside": "outside",
    "rgb": "rgb",
    "alpha": "alpha",
    "maxAlpha": "max_alpha",
}
"""Names of the options of the texture lookup, and their fields."""
RANGES = {"rgb": slice(0, 3), "alpha": slice(3, 4)}
"""Columns of texels that share ends."""


def coefficient(degree: int, order: int) -> str:
    """Return the name of the attribute of a spherical harmonic."""
    return f"{SPLATS}:SH_DEGREE_{degree}_COEF_{order}"


# Writing


def save_gltf(
    path: str | os.PathLike[str], model: Model, *, textures: bool = True, texels: TexelKind = "float32"
) -> None:
    """Write a model's live rows as glTF splats, with its appearance and origin.

    Args:
      path: the file. *.gltf has its numbers in a *.bin of the same name, any other name is one *.glb. Existing ones are
        replaced once the new ones are complete.
      model: of Gaussians with or without textures, exponents and bands.
      textures: also write textures, degrees and shapes of kernels, as the extension A2TG_splat_textures. False writes
        plain splats of any model, as `save_ply` does.
      texels: their type in the file, "float32" exactly or "uint8" in a quarter of the bytes.

    Raises:
      ValueError: if the model has no Gaussians, an appearance that the extension cannot hold, or a number that is not
        finite or too large.

    Examples:
      >>> a2tg.save_gltf("scene.glb", model)
      >>> a2tg.load_gltf("scene.glb").num
      200
    """
    check_literal("texels", texels, TexelKind)
    path = checked_path(path, "save_gltf")
    model = checked_live(model)
    # glTF has no accessors of count 0.
    if not model.num:
        raise ValueError("model has no Gaussians; a glTF file has at least one")
    if textures:
        check_encodable(model.appearance, "a glTF file", "a *.ply, or textures=False here, holds their plain splats")
    builder = Builder()
    splats = splats_of(model, keeps_shapes=textures)
    attributes = {
        # glTF requires bounds of POSITION, and of no other attribute.
        MEANS: builder.add(splats.means, has_bounds=True),
        # wxyz to glTF's xyzw.
        ROTATION: builder.add(splats.quats[:, [1, 2, 3, 0]]),
        SCALE: builder.add(splats.scales),
        OPACITY: builder.add(splats.opacities),
    }
    # Linear RGB and opacity as bytes, for programs that show points.
    shown = linear_colors(np.clip(splats.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0))
    points = to_bytes(255 * np.concatenate([shown, splats.opacities[:, None]], axis=1))
    attributes["COLOR_0"] = builder.add(points, normalized=True)
    # The extension stores one attribute for each coefficient, not one array.
    for degree in range(NUM_BASES.index(splats.sh.shape[1]) + 1):
        for order in range(2 * degree + 1):
            index = NUM_BASES[degree] - 2 * degree - 1 + order
            attributes[coefficient(degree, order)] = builder.add(splats.sh[:, index])
    described: dict[str, Any] = dict(DESCRIBED)
    kept: dict[str, Any] = {}
    if textures:
        extended = _extension_of(builder, model, texels)
        if extended:
            described["extensions"] = {EXTENSION: extended}
        kept["appearance"] = appearance_to_dict(model.appearance)
    kept["background"] = list(model.background)
    if model.origin is not None:
        kept["origin"] = origin_to_json(model.origin)
    matrix = matrix_of(upright(model.origin, "y"))
    # glTF's matrices are column by column: transposed, then row by row.
    node = {"name": "splats", "mesh": 0, "matrix": matrix.T.ravel().tolist()}
    # Mode 0: points, which programs without the extension show.
    primitive = {"attributes": attributes, "mode": 0, "extensions": {SPLATS: described}, "extras": {OWN: kept}}
    used = [SPLATS, *described.get("extensions", {})]
    builder.save(path, {"extensionsUsed": used, **scene_of_one(node, primitive)})


def _extension_of(builder: Builder, model: Model, kind: TexelKind) -> dict[str, Any]:
    """Add the appearance of splats to a file, and return the extension's object; empty for plain splats."""
    described: dict[str, Any] = {}
    rows = rows_of_model(model)
    appearance = model.appearance
    if appearance.texture_options is not None and rows.sizes is not None and rows.texels is not None:
        described |= {name: getattr(appearance.texture_options, field) for name, field in OPTIONS.items()}
        described["sizes"] = builder.add(rows.sizes.astype(np.uint8), is_attribute=False)
        if len(rows.texels) and kind == "float32":
            described["texels"] = builder.add(rows.texels.astype(np.float32), is_attribute=False)
        elif len(rows.texels):
            codes = np.zeros(rows.texels.shape, np.uint8)
            ranges: dict[str, list[float]] = {}
            for name, columns in RANGES.items():
                ends = ends_of(rows.texels[:, columns], 8)
                codes[:, columns] = quantised(rows.texels[:, columns], ends, 8)
                ranges[name] = list(ends)
            described["texels"] = builder.add(codes, normalized=True, is_attribute=False)
            described["texelRanges"] = ranges
    if appearance.bands is not None:
        described["baseDegree"] = model.gaussians.sh_degree
        described["degrees"] = builder.add(rows.degrees.astype(np.uint8), is_attribute=False)
    if rows.shapes is not None:
        described["shapes"] = builder.add(log_exponents_of(rows.shapes).astype(np.float32), is_attribute=False)
    if described:
        described["maxAlpha"] = appearance.alpha_limit
    return described


# Reading


def load_gltf(path: str | os.PathLike[str]) -> Model:
    """Return the model of a *.glb or *.gltf of splats, float32, of this program or another.

    All splats of the scene become one model. Files of `save_gltf` restore textures, degrees and origin, in the model's
    world. Splats of other programs are rotated so that +z is up. The thinnest axis of an ellipsoid becomes its normal,
    with a warning if that changes much.

    Args:
      path: the file, *.glb or *.gltf.

    Returns:
      The model, float32.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not glTF 2.0, is damaged, holds no splats, or needs an unsupported extension.
    """
    path = checked_path(path, "load_gltf")
    with reading(path):
        document = Document(path)
        unknown = [name for name in document.json.get("extensionsRequired", []) if name not in READ]
        if unknown:
            raise ValueError(f"needs the extension {shortened(unknown[0])}, which this program does not read")
        return joined_parts(_parts(document), "y")


def _parts(document: Document) -> Iterator[tuple[Model, np.ndarray]]:
    """Yield the model of each set of splats in the scene, and the matrix from its world to the scene's."""
    for node, matrix in mesh_nodes(document):
        for primitive in document.entry("meshes", node["mesh"])["primitives"]:
            if {SPLATS, SPZ[-1]} & {*primitive.get("extensions", {})}:
                yield _model_of(document, primitive), matrix


def _model_of(document: Document, primitive: Mapping[str, Any]) -> Model:
    """Return the model of some splats, in the world of their node."""
    described = primitive["extensions"].get(SPLATS, {})
    inside = primitive["extensions"] | described.get("extensions", {})
    for name in SPZ:
        if name in inside:
            # Cesium and others read the axes of the SPZ as glTF's, which are its default axes.
            data = bytes(document.view(inside[name]["bufferView"], name))
            return decode_spz(data, document.path, GLTF_AXES)
    splats = _splats(document, primitive["attributes"])
    for name in ("kernel", "colorSpace"):
        value = described.get(name)
        if value != DESCRIBED[name]:
            warn(f"{document.path}: its splats have the {name} {shortened(value)}; they are read as {DESCRIBED[name]}")
    extras = primitive.get("extras", {})
    kept = extras.get(OWN, {}) if isinstance(extras, dict) else {}
    origin = origin_of(kept["origin"], kept["origin"]) if "origin" in kept else None
    extended = described.get("extensions", {}).get(EXTENSION)
    if extended is not None:
        shown, rows, base_degree = _shown(document, extended, splats)
        appearance = _kept_appearance(kept, shown, is_described=True)
        return model_of(rows, base_degree, appearance, origin, background_of(kept))
    appearance = _kept_appearance(kept, Appearance(), is_described=False)
    background = background_of(kept)
    return model_of_splats(splats, document.path, appearance=appearance, background=background, origin=origin)


def _splats(document: Document, attributes: Mapping[str, object]) -> Ellipsoids:
    def numbers(name: str, kind: str) -> np.ndarray:
        if name not in attributes:
            raise ValueError(f"its splats lack {name}")
        return document.numbers(attributes[name], kind, name)

    means = numbers(MEANS, "VEC3")
    quats = numbers(ROTATION, "VEC4")[:, [3, 0, 1, 2]]  # xyzw to wxyz.
    scales = numbers(SCALE, "VEC3")
    opacities = numbers(OPACITY, "SCALAR")[:, 0]
    tried = range(MAX_DEGREE + 2)  # One more than is read, for the warning.
    highest = max((degree for degree in tried if coefficient(degree, 0) in attributes), default=0)
    degree = degree_to_read(highest, str(document.path))
    names = [coefficient(band, order) for band in range(degree + 1) for order in range(2 * band + 1)]
    sh = [numbers(name, "VEC3") for name in names]
    if {len(column) for column in (quats, scales, opacities, *sh)} != {len(means)}:
        raise ValueError("the attributes of its splats differ in length")
    return Ellipsoids(means, quats, scales, opacities, np.stack(sh, axis=1))


def _shown(document: Document, described: Mapping[str, Any], splats: Ellipsoids) -> tuple[Appearance, Rows, int]:
    """Return the template, the tables and the common degree of splats, from the extension's object. ValueError: a field
    is missing, out of range, or contradicts the splats."""
    num, highest = splats.sh.shape[:2]
    base_degree = sh_degree = NUM_BASES.index(highest)
    has_textures, has_degrees, has_shapes = (name in described for name in ("sizes", "degrees", "shapes"))
    names = {field: described[name] for name, field in OPTIONS.items() if name in described}
    options = config_from_dict(TextureOptions, names, EXTENSION)
    if not 0 < options.max_alpha < 1:
        raise ValueError(f"{EXTENSION}.maxAlpha must be in (0, 1); got {options.max_alpha!r}")
    appearance = Appearance(
        texture=Texture(options=options) if has_textures else None,
        exponents=Exponents() if has_shapes else None,
        bands=Bands() if has_degrees else None,
        max_alpha=None if has_textures else options.max_alpha,
    )

    def integers(name: str, kind: str, most: int) -> np.ndarray:
        values = document.numbers(described[name], kind, f"{EXTENSION}.{name}")
        if len(values) != num or not ((values >= 0) & (values <= most) & (values % 1 == 0)).all():
            raise ValueError(f"{EXTENSION}.{name} must be {num} integers in 0..{most}")
        return values.astype(np.int64)

    sizes = texels = shapes = None
    degrees = np.full(num, sh_degree)
    if has_textures:
        sizes = integers("sizes", "VEC2", MAX_SIDE)
        texels = _texels(document, described, int(sizes.prod(axis=1).sum()))
    if has_degrees:
        degrees = integers("degrees", "SCALAR", sh_degree)[:, 0]
        base_degree = described["baseDegree"]
        check_int(f"{EXTENSION}.baseDegree", base_degree, 0, int(degrees.min(initial=sh_degree)))
    if has_shapes:
        log_exponents = document.numbers(described["shapes"], "SCALAR", f"{EXTENSION}.shapes")[:, 0]
        if len(log_exponents) != num:
            raise ValueError(f"{EXTENSION}.shapes must be {num} numbers; got {len(log_exponents)}")
        shapes = checked_shapes(log_exponents)
    # No rows are dropped: the extension's tables are by row.
    gaussians = gaussians_of(splats, document.path, is_flat=has_textures or has_shapes, keeps_all=True)
    # `Bands` keeps tables up to the highest degree, empty ones included.
    sh = splats.sh
    if has_degrees:
        sh = np.pad(sh, ((0, 0), (0, NUM_BASES[-1] - highest), (0, 0)))
    counts = [count for count in NUM_BASES if count <= sh.shape[1]]
    bands = [sh[degrees >= degree, count - 2 * degree - 1 : count] for degree, count in enumerate(counts)]
    rows = Rows(*columns_of(gaussians), degrees, tuple(bands), sizes, texels, shapes)
    return appearance, rows, base_degree


def _texels(document: Document, described: Mapping[str, Any], count: int) -> np.ndarray:
    """Return the `count` texels [T, 4] of all textures."""
    texels = np.zeros((0, 4), np.float32)
    if "texels" in described:
        texels = document.numbers(described["texels"], "VEC4", f"{EXTENSION}.texels")
    if len(texels) != count:
        raise ValueError(f"{EXTENSION}.sizes need {count} texels, but there are {len(texels)}")
    for name, columns in RANGES.items() if "texelRanges" in described else ():
        ends = number_array(described["texelRanges"][name], 2, f"{EXTENSION}.texelRanges.{name}").tolist()
        texels[:, columns] = dequantised(texels[:, columns] * 255.0, Ends(*ends), 8)
    return texels


def _kept_appearance(kept: Mapping[str, Any], shown: Appearance, *, is_described: bool) -> Appearance:
    """Return the appearance of the saved model, with its training options, if it looks the same.

    Args:
      kept: contents of the extras.
      shown: appearance by the rest of the file.
      is_described: whether the file has the extension.
    """
    if "appearance" not in kept:
        return shown
    appearance = appearance_from_dict(kept["appearance"])
    # Extras may be out of date if another program has edited the extension: then this decides.
    is_same = appearance.description == shown.description
    if is_described:
        is_same &= appearance.alpha_limit == shown.alpha_limit
        saved = appearance.texture_options
        there = shown.texture_options
        for field in OPTIONS.values():
            if field != "max_alpha":
                is_same &= getattr(saved, field, None) == getattr(there, field, None)
    return appearance if appearance.is_portable and is_same else shown
