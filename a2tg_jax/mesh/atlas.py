"""Texture atlases: a mesh unwrapped into charts, and the place in the world of each texel (host)."""

import importlib
from types import ModuleType
from typing import NamedTuple

import numpy as np

from a2tg_jax.mesh.raster import draw
from a2tg_jax.mesh.triangles import Mesh

PADDING = 2
"""Texels between charts."""
SMALLEST_SIDE, LARGEST_SIDE = 16, 8_192


class Texels(NamedTuple):
    """Texels that charts cover."""

    place: np.ndarray
    """[T] number in the atlas, row by row from the top."""
    position: np.ndarray
    """[T, 3] float32 position in the world."""
    normal: np.ndarray
    """[T, 3] float32 unit normal of the face."""
    color: np.ndarray
    """[T, 3] float32 colour in [0, 1] between those of the vertices; grey without them."""


def check_texture(size: int) -> ModuleType:
    """Return the library xatlas.

    Raises:
      ValueError: if it is not installed, or the side of an atlas is out of range.
    """
    if not SMALLEST_SIDE <= size <= LARGEST_SIDE:
        raise ValueError(f"texture_size must lie in {SMALLEST_SIDE}..{LARGEST_SIDE} texels; got {size}")
    try:
        return importlib.import_module("xatlas")
    except ImportError:
        raise ValueError("a texture needs xatlas, which is not installed: pip install 'a2tg-jax[mesh]'") from None


def unwrapped(mesh: Mesh, size: int) -> Mesh:
    """Return the mesh with positions in a square atlas, by xatlas; vertices at seams are repeated.

    Args:
      mesh: a mesh.
      size: side of the atlas in texels.

    Raises:
      ValueError: if xatlas is not installed, or the side is out of range.
    """
    xatlas = check_texture(size)
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bruteForce = size, PADDING, False
    atlas.generate(xatlas.ChartOptions(), pack)
    source, faces, uv = atlas.get_mesh(0)
    return Mesh(
        vertices=mesh.vertices[source],
        faces=faces.astype(np.int32),
        colors=None if mesh.colors is None else mesh.colors[source],
        uv=np.asarray(uv, np.float32),
    )


def texels_of(mesh: Mesh, size: int) -> Texels:
    """Return the texels of a square atlas of `size` that the charts of an unwrapped mesh cover."""
    if mesh.uv is None:
        raise ValueError("the mesh has no positions in a texture; unwrap it first")
    corners = (mesh.uv * (size, -size) + (0, size)).astype(np.float32)[mesh.faces]
    drawn = draw(corners, np.ones(mesh.faces.shape, np.float32), size, size)
    place = np.flatnonzero(drawn.face >= 0)
    hit, weights = drawn.face.reshape(-1)[place], drawn.weights.reshape(-1, 3)[place]
    faces, normals = mesh.faces[hit], mesh.face_normals[hit]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    colors = np.full((mesh.num_vertices, 3), 128, np.uint8) if mesh.colors is None else mesh.colors
    position, color = (
        np.einsum("tk,tkc->tc", weights, rows[faces].astype(np.float32)) for rows in (mesh.vertices, colors)
    )
    return Texels(place, position, normals.astype(np.float32), color / 255)
