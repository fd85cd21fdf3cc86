"""Textures of meshes from pictures: each texel is a weighted mean over the views that see it (host)."""

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from a2tg_jax.core.cameras import Camera
from a2tg_jax.mesh.atlas import Texels, texels_of, unwrapped
from a2tg_jax.mesh.raster import Raster, draw_view
from a2tg_jax.mesh.triangles import Mesh

POWER = 6
"""Power of cosine over distance that weighs a view: the higher, the more the best view decides."""
LEAST_FACING = 0.15
"""Smallest cosine between the normal and the direction to a camera that sees a texel."""
HIDDEN = 0.01
"""Distance behind the mesh, in units of its depth, from which on a texel is hidden."""
CHUNK = 1 << 20
"""Texels that are projected at a time."""

Picture = tuple[Camera, np.ndarray, np.ndarray | None]
"""A view: its camera, its picture [H, W, 3] in [0, 1], and the mask [H, W] of the pixels that count, or None."""


def texture_mesh(mesh: Mesh, pictures: Iterable[Picture], *, size: int = 2048) -> Mesh:
    """Return the mesh with a texture atlas filled from pictures.

    A texel takes the weighted mean of the pictures that see it. The weight is (cosine·focal length/distance)⁶, so that
    near views from the front decide. Hidden texels are found by drawing the mesh into each view. Texels that no view
    sees keep the colours of the vertices.

    Args:
      mesh: a mesh in the world of the cameras.
      pictures: (camera, picture [H, W, 3] in [0, 1], mask [H, W] of the pixels that count, or None).
      size: side of the atlas in texels.

    Returns:
      The mesh with `uv` and `texture`; vertices at the seams of charts are repeated.

    Raises:
      ValueError: if xatlas is not installed (`pip install 'a2tg-jax[mesh]'`), or the size is out of range.
    """
    mesh = unwrapped(mesh, size)
    texels = texels_of(mesh, size)
    total = np.zeros((len(texels.place), 3), np.float32)
    weight = np.zeros(len(texels.place), np.float32)
    for camera, picture, mask in pictures:
        drawn = draw_view(mesh, camera)
        for start in range(0, len(weight), CHUNK):
            part = Texels(*(rows[start : start + CHUNK] for rows in texels))
            seen, own, color = _seen(part, camera, np.asarray(picture, np.float32), mask, drawn)
            weight[start + seen] += own
            total[start + seen] += own[:, None] * color
    color = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-30)[:, None], texels.color)
    return Mesh(mesh.vertices, mesh.faces, mesh.colors, mesh.uv, _filled(texels.place, color, size))


def _seen(
    texels: Texels, camera: Camera, picture: np.ndarray, mask: np.ndarray | None, drawn: Raster
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the texels that a view sees, as indices [S], its weights [S] for them, and its colours [S, 3]."""
    viewmat, K = np.asarray(camera.viewmat, np.float32), np.asarray(camera.K, np.float32)
    at = texels.position @ viewmat[:3, :3].T + viewmat[:3, 3]
    toward = -np.sum(at * (texels.normal @ viewmat[:3, :3].T), axis=1)
    seen = np.flatnonzero((at[:, 2] > 0) & (toward > 0))
    at, toward = at[seen], toward[seen]
    x, y = ((at / at[:, 2:]) @ K[:2].T).T
    distance = np.linalg.norm(at, axis=1)
    is_inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height) & (toward > LEAST_FACING * distance)
    row, column = (np.where(is_inside, each, 0).astype(int) for each in (y, x))
    is_seen = is_inside & (at[:, 2] < (1 + HIDDEN) * drawn.depth[row, column])
    if mask is not None:
        is_seen &= mask[row, column]
    places = np.stack([y, x])[:, is_seen] - np.float32(0.5)
    channels = [map_coordinates(picture[..., channel], places, order=1, mode="nearest") for channel in range(3)]
    distance = distance[is_seen]
    own = (toward[is_seen] * K[0, 0] / camera.width / distance**2) ** POWER
    return seen[is_seen], own.astype(np.float32), np.stack(channels, -1)


def _filled(place: np.ndarray, color: np.ndarray, size: int) -> np.ndarray:
    """Return the atlas [size, size, 3] uint8, with the nearest texel's colour where no chart lies."""
    atlas = np.zeros((size * size, 3), np.uint8)
    atlas[place] = np.rint(255 * np.clip(color, 0, 1))
    is_empty = np.ones(size * size, bool)
    is_empty[place] = False
    if not len(place):
        return atlas.reshape(size, size, 3)
    rows, columns = distance_transform_edt(is_empty.reshape(size, size), return_distances=False, return_indices=True)
    filled: np.ndarray = atlas.reshape(size, size, 3)[rows, columns]
    return filled
