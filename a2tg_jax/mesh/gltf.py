"""Meshes as binary glTF 2.0 (GLB) files."""

import io
import json
import struct
from typing import Any

import numpy as np
from PIL import Image

from a2tg_jax.mesh.triangles import Mesh

FLOAT, UNSIGNED_INT, UNSIGNED_SHORT = 5126, 5125, 5123
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
JPEG_QUALITY = 92
FAR = 100.0
"""Distance from the origin, in extents, from which on positions are relative to the middle, as float32 needs."""


class _Binary:
    """Buffer of a file, with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, **options: Any) -> int:
        """Append bytes and return the index of their view."""
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **options})
        self.data += content
        return len(self.views) - 1

    def accessor(self, rows: np.ndarray, component: int, kind: str, target: int, **options: Any) -> int:
        """Append an array and return the index of its accessor."""
        stride = {"byteStride": rows.strides[0]} if target == ARRAY_BUFFER else {}
        view = self.view(rows.tobytes(), target=target, **stride)
        self.accessors.append(
            {"bufferView": view, "componentType": component, "count": len(rows), "type": kind, **options}
        )
        return len(self.accessors) - 1


def glb_of(mesh: Mesh) -> bytes:
    """Return a GLB file of a mesh, unlit, in the mesh's own axes.

    Far from the origin, the node of the mesh holds the translation, and positions are relative to it.
    """
    binary = _Binary()
    middle = _middle(mesh.vertices)
    primitive, material = _primitive(mesh, middle, binary)
    node: dict[str, Any] = {"mesh": 0, **({"translation": middle.tolist()} if middle.any() else {})}
    root: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "a2tg-jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "extensionsUsed": ["KHR_materials_unlit"],
        "accessors": binary.accessors,
    }
    if mesh.texture is not None:
        file = io.BytesIO()
        Image.fromarray(mesh.texture).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        root["images"] = [{"bufferView": binary.view(file.getvalue()), "mimeType": "image/jpeg"}]
        root["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        root["textures"] = [{"source": 0, "sampler": 0}]
    root["bufferViews"] = binary.views
    data = bytes(binary.data) + bytes(-len(binary.data) % 4)
    root["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(root, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    head = struct.pack("<III", 0x46546C67, 2, size) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def _primitive(mesh: Mesh, middle: np.ndarray, binary: _Binary) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the primitive of a mesh and its material, after appending its arrays."""
    positions = np.ascontiguousarray(mesh.vertices - middle, "<f4")
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": binary.accessor(positions, FLOAT, "VEC3", ARRAY_BUFFER, **bounds)}
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    if mesh.texture is not None and mesh.uv is not None:
        # The origin of glTF's textures is the upper left corner.
        uv = np.ascontiguousarray(mesh.uv * (1, -1) + (0, 1), "<f4")
        attributes["TEXCOORD_0"] = binary.accessor(uv, FLOAT, "VEC2", ARRAY_BUFFER)
        surface["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        opaque = np.full((mesh.num_vertices, 1), 65535)
        rows = np.ascontiguousarray(np.hstack([np.rint(65535 * linear(mesh.colors / 255)), opaque]), "<u2")
        attributes["COLOR_0"] = binary.accessor(rows, UNSIGNED_SHORT, "VEC4", ARRAY_BUFFER, normalized=True)
    corners = np.ascontiguousarray(mesh.faces, "<u4").reshape(-1)
    indices = binary.accessor(corners, UNSIGNED_INT, "SCALAR", ELEMENT_ARRAY_BUFFER)
    material = {"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    return {"attributes": attributes, "indices": indices, "material": 0}, material


def _middle(vertices: np.ndarray) -> np.ndarray:
    """Return the middle of positions far from the origin; otherwise zeros."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2
    return middle if np.abs(middle).max() > FAR * (high - low).max() else np.zeros(3)


def linear(color: np.ndarray) -> np.ndarray:
    """Return linear colours of sRGB colours in [0, 1]."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
