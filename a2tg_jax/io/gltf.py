"""glTF files of splats: KHR_gaussian_splatting, as *.glb, or *.gltf with a *.bin beside it.

Splats are points of a mesh: means, rotations, scales, opacities and spherical harmonics are its attributes. They stay
in the model's world; the matrix of their node leads to glTF's, which has +y up. Textures and degrees of splats are in
the extension A2TG_splat_textures, which other programs leave aside. docs/formats.md describes both.
"""

import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.core.gaussians import SH_C0, check_gaussians
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.host.text import shortened
from a2tg_jax.io.exchange import (
    Ellipsoids,
    gaussians_of,
    joined_parts,
    linear_colors,
    matrix_of,
    origin_from_json,
    origin_to_json,
    reading,
    similarity_of,
    splats_of,
    upright,
    whole_splats,
)
from a2tg_jax.io.gltf_nodes import mesh_nodes
from a2tg_jax.io.gltf_reader import Document
from a2tg_jax.io.gltf_textures import EXTENSION, SplatTextures, TexelKind, add_textures, kept_appearance, shown_of
from a2tg_jax.io.gltf_writer import Builder
from a2tg_jax.io.model_file import appearance_to_dict, background_of
from a2tg_jax.io.model_rows import Rows, check_encodable, model_of, rows_of_model
from a2tg_jax.io.sh_degrees import HIGHEST_DEGREE, degree_to_read
from a2tg_jax.io.suffixes import check_saved, check_suffix
from a2tg_jax.io.validate import check_model
from a2tg_jax.model import Model

SPLATS = "KHR_gaussian_splatting"
READ = {SPLATS, EXTENSION, "KHR_mesh_quantization"}
"""Extensions that a file may require."""
MEANS, ROTATION, SCALE, OPACITY = "POSITION", f"{SPLATS}:ROTATION", f"{SPLATS}:SCALE", f"{SPLATS}:OPACITY"
COLOR = "COLOR_0"
DESCRIBED = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
OWN = "a2tg"
"""Name of what the extras of splats keep of their model."""
POINTS = 0
MOST_PRIMITIVES = 256
"""Largest number of sets of splats in one file."""


def coefficient(degree: int, order: int) -> str:
    """Return the name of the attribute of a spherical harmonic."""
    return f"{SPLATS}:SH_DEGREE_{degree}_COEF_{order}"


def save_gltf(
    path: str | os.PathLike[str], model: Model, *, textures: bool = True, texels: TexelKind = "float32"
) -> None:
    """Write a model's live rows as splats of glTF, with its appearance and its origin.

    Args:
      path: the file. *.gltf has its numbers in a *.bin beside it, any other name is one *.glb. Older ones are replaced
        once the new ones are whole.
      model: of Gaussians with or without textures, exponents and bands.
      textures: write textures, degrees and shapes of kernels, too, as the extension A2TG_splat_textures. False writes
        plain splats of any model, as `save_ply` does.
      texels: what keeps them, "float32" exactly or "uint8" in a quarter of the bytes.

    Raises:
      ValueError: if the model has no Gaussians, shows what the extension cannot hold, or has a number that is not
        finite or too large.
    """
    check_saved(path, model, "save_gltf")
    check_gaussians(model.gaussians, "model.gaussians")
    if texels not in get_args(TexelKind):
        raise ValueError(f"texels must be {' or '.join(get_args(TexelKind))}; got {shortened(repr(texels))}")
    model = model.live
    check_model(model)
    if not model.num:
        raise ValueError("model has no Gaussians; a glTF file has at least one")
    if textures:
        check_encodable(model.appearance, "a glTF file", "a *.ply, or textures=False here, holds their plain splats")
    builder = Builder()
    primitive = _primitive(builder, model, texels if textures else None)
    used = [SPLATS, *primitive["extensions"][SPLATS].get("extensions", {})]
    node = {"name": "splats", "mesh": 0, "matrix": matrix_of(upright(model.origin, "y")).T.ravel().tolist()}
    described = {
        "asset": {"version": "2.0", "generator": "a2tg-jax"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
    }
    builder.save(Path(path), described)


def _primitive(builder: Builder, model: Model, texels: TexelKind | None) -> dict[str, Any]:
    """Return the points of the mesh; `texels` None leaves textures, degrees and shapes out."""
    splats = splats_of(model, keeps_shapes=texels is not None)
    attributes = {
        MEANS: builder.add(splats.means, has_bounds=True),
        ROTATION: builder.add(splats.quats[:, [1, 2, 3, 0]]),
        SCALE: builder.add(splats.scales),
        OPACITY: builder.add(splats.opacities),
        COLOR: builder.add(_point_colors(splats), normalized=True),
    }
    for degree in range(NUM_BASES.index(splats.sh.shape[1]) + 1):
        for order in range(2 * degree + 1):
            index = NUM_BASES[degree] - 2 * degree - 1 + order
            attributes[coefficient(degree, order)] = builder.add(splats.sh[:, index])
    described: dict[str, Any] = dict(DESCRIBED)
    if texels is not None:
        rows = rows_of_model(model)
        shown = add_textures(builder, rows, model.appearance, model.gaussians.sh_degree, texels)
        described |= {"extensions": {EXTENSION: shown}} if shown else {}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {SPLATS: described}}
    return primitive | _extras(model, has_appearance=texels is not None)


def _point_colors(splats: Ellipsoids) -> np.ndarray:
    """Return linear RGB and opacity [N, 4] as bytes, for programs that show points."""
    shown = np.clip(splats.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0)
    colors = np.concatenate([linear_colors(shown), splats.opacities[:, None]], axis=1)
    rounded: np.ndarray = np.rint(255 * colors).astype(np.uint8)
    return rounded


def _extras(model: Model, *, has_appearance: bool) -> dict[str, Any]:
    """Return what only this program reads."""
    kept: dict[str, Any] = {"appearance": appearance_to_dict(model.appearance)} if has_appearance else {}
    kept["background"] = list(model.background)
    if model.origin is not None:
        kept["origin"] = origin_to_json(model.origin)
    return {"extras": {OWN: kept}} if kept else {}


def load_gltf(path: str | os.PathLike[str]) -> Model:
    """Return the model of a *.glb or *.gltf of splats, float32, of this program or another.

    All splats of the scene make one model. Files of `save_gltf` bring textures, degrees and origin along, and the
    model back in its world. Splats of other programs are turned so that +z is up. The thinnest axis of ellipsoids
    becomes the normal, with a warning if that changes much.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not glTF 2.0, is damaged, holds no splats, or needs an extension that is not known here.
    """
    check_suffix(path, "load_gltf")
    return reading(path, lambda: _loaded(path))


def _loaded(path: str | os.PathLike[str]) -> Model:
    document = Document(path)
    required = document.json.get("extensionsRequired", [])
    if unknown := [name for name in required if name not in READ]:
        raise ValueError(f"needs the extension {shortened(unknown[0])}, which this program does not read")
    parts: list[tuple[Model, Similarity]] = []
    for primitive, matrix in _primitives(document):
        parts.append((_model_of(document, primitive), similarity_of(matrix, "the transform of its node")))
        if len(parts) > MOST_PRIMITIVES:
            raise ValueError(f"holds more than {MOST_PRIMITIVES} sets of splats")
    if not parts:
        raise ValueError(f"holds no splats ({SPLATS})")
    return joined_parts(parts, "y")


def _primitives(document: Document) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the splats of the scene, and the matrix from each to the world."""
    for node, matrix in mesh_nodes(document):
        for primitive in document.entry("meshes", node["mesh"])["primitives"]:
            if SPLATS in primitive.get("extensions", {}):
                yield primitive, matrix


def _model_of(document: Document, primitive: Mapping[str, Any]) -> Model:
    """Return the model of some splats, in the world of their node."""
    splats = _splats(document, primitive)
    described = primitive["extensions"][SPLATS]
    _warn_of_others(document.path, described)
    extras = primitive.get("extras", {})
    kept = extras.get(OWN, {}) if isinstance(extras, dict) else {}
    origin = origin_from_json(kept["origin"]) if "origin" in kept else None
    degree = NUM_BASES.index(splats.sh.shape[1])
    extended = described.get("extensions", {}).get(EXTENSION)
    if extended is None:
        gaussians = gaussians_of(whole_splats(splats, document.path), document.path, is_flat=False)
        appearance = kept_appearance(kept, Appearance(), is_told=False)
        model = Model(gaussians, appearance, background=background_of(kept), origin=origin)
        check_model(model)
        return model
    shown = shown_of(document, extended, len(splats.means), degree)
    rows = _rows(splats, shown, document.path)
    appearance = kept_appearance(kept, shown.appearance, is_told=True)
    return model_of(rows, shown.base_degree, appearance, origin, background_of(kept))


def _splats(document: Document, primitive: Mapping[str, Any]) -> Ellipsoids:
    attributes = primitive["attributes"]

    def numbers(name: str, kind: str) -> np.ndarray:
        if name not in attributes:
            raise ValueError(f"its splats lack {name}")
        return document.numbers(attributes[name], (kind,), name)

    means, quats = numbers(MEANS, "VEC3"), numbers(ROTATION, "VEC4")[:, [3, 0, 1, 2]]
    scales, opacities = numbers(SCALE, "VEC3"), numbers(OPACITY, "SCALAR")[:, 0]
    tried = range(HIGHEST_DEGREE + 2)  # One more than is read, for the warning.
    found = max((degree for degree in tried if coefficient(degree, 0) in attributes), default=0)
    degree = degree_to_read(found, str(document.path))
    names = [coefficient(band, order) for band in range(degree + 1) for order in range(2 * band + 1)]
    columns = [means, quats, scales, opacities, *(numbers(name, "VEC3") for name in names)]
    if len({len(column) for column in columns}) > 1:
        raise ValueError("the attributes of its splats differ in length")
    return Ellipsoids(means, quats, scales, opacities, np.stack(columns[4:], axis=1))


def _rows(splats: Ellipsoids, shown: SplatTextures, path: Path) -> Rows:
    """Return the tables of splats that show textures or have degrees."""
    gaussians = gaussians_of(splats, path, is_flat=shown.sizes is not None or shown.shapes is not None)
    num, highest = splats.sh.shape[:2]
    dense = np.zeros((num, NUM_BASES[-1] if shown.degrees is not None else highest, 3), np.float32)
    dense[:, :highest] = splats.sh
    degrees = np.full(num, shown.base_degree) if shown.degrees is None else shown.degrees
    bands = [
        dense[degrees >= degree, count - 2 * degree - 1 : count]
        for degree, count in enumerate(NUM_BASES)
        if count <= dense.shape[1]
    ]
    return Rows(
        np.asarray(gaussians.means), np.asarray(gaussians.quats), np.asarray(gaussians.log_scales),
        np.asarray(gaussians.logit_opacities), degrees, tuple(bands), shown.sizes, shown.texels, shown.shapes,
    )  # fmt: skip


def _warn_of_others(path: Path, described: Mapping[str, Any]) -> None:
    """Warn of splats that are read as what they are not."""
    for name in ("kernel", "colorSpace"):
        if (found := described.get(name)) != DESCRIBED[name]:
            message = f"{path}: its splats have the {name} {shortened(found)}; they are read as {DESCRIBED[name]}"
            warnings.warn(message, stacklevel=6)
