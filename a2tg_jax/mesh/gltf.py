"""Meshes as binary glTF 2.0 (GLB) files."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a2tg_jax.core.similarity import Similarity
from a2tg_jax.io.gltf import OWN
from a2tg_jax.io.gltf_container import Builder
from a2tg_jax.io.other_programs import linear_colors, matrix_of, upright
from a2tg_jax.mesh.triangles import Mesh

JPEG_QUALITY = 92
FAR = 100.0
"""Distance from the origin, in extents, from which on positions are relative to the middle, as float32 needs."""


def save_glb(path: Path, mesh: Mesh, transform: Similarity | None) -> None:
    """Write a GLB file of a mesh, unlit.

    Args:
      path: the file; an older one is replaced once the new one is whole.
      mesh: a mesh.
      transform: from the original world to that of the mesh. The node then leads to the upright world that `save_gltf`
        places splats in, and its extras have the transform if the original world lies far from there. None writes the
        mesh as it is; far from the origin, positions are relative to the translation of the node.
    """
    builder = Builder()
    middle = _middle(mesh.vertices) if transform is None else np.zeros(3)
    primitive, material = _primitive(mesh, middle, builder)
    node: dict[str, Any] = {"name": "mesh", "mesh": 0}
    if transform is not None:
        node["matrix"] = matrix_of(upright(transform, "y")).T.ravel().tolist()
        if _middle(mesh.transform(transform.inverse()).vertices).any():
            kept = {"scale": float(transform.scale), "rotation": np.asarray(transform.rotation).tolist()}
            node["extras"] = {OWN: kept | {"translation": np.asarray(transform.translation).tolist()}}
    elif middle.any():
        node["translation"] = middle.tolist()
    described: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "a2tg-jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    if mesh.texture is not None:
        file = io.BytesIO()
        Image.fromarray(mesh.texture).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        described["images"] = [{"bufferView": builder.add_bytes(file.getvalue()), "mimeType": "image/jpeg"}]
        described["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        described["textures"] = [{"source": 0, "sampler": 0}]
    builder.save(path, described)


def _primitive(mesh: Mesh, middle: np.ndarray, builder: Builder) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the primitive of a mesh and its material, after adding its arrays."""
    attributes = {"POSITION": builder.add((mesh.vertices - middle).astype(np.float32), has_bounds=True)}
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    if mesh.texture is not None and mesh.uv is not None:
        # The origin of glTF's textures is the upper left corner.
        attributes["TEXCOORD_0"] = builder.add((mesh.uv * (1, -1) + (0, 1)).astype(np.float32))
        surface["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        opaque = np.full((mesh.num_vertices, 1), 65535)
        rows = np.hstack([np.rint(65535 * linear_colors(mesh.colors / 255)), opaque])
        attributes["COLOR_0"] = builder.add(rows.astype(np.uint16), normalized=True)
    indices = builder.add(mesh.faces.astype(np.uint32).reshape(-1), is_attribute=False)
    material = {"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    return {"attributes": attributes, "indices": indices, "material": 0}, material


def _middle(vertices: np.ndarray) -> np.ndarray:
    """Return the middle of positions far from the origin; otherwise zeros."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2
    return middle if np.abs(middle).max() > FAR * (high - low).max() else np.zeros(3)
