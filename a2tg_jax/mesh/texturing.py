"""Textures of meshes from pictures: each texel is a weighted mean over the views that show it (host)."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from a2tg_jax import Camera
from a2tg_jax.base.checks import check_floats, check_mask
from a2tg_jax.host.optional import optional
from a2tg_jax.mesh.triangles import Mesh

POWER = 6
"""Power of cosine over distance in a view's weight: the higher, the more the best view dominates."""
LEAST_FACING = 0.15
"""Smallest cosine between a texel's normal and the direction to a camera that shows it."""
HIDDEN = 0.01
"""Distance behind the mesh, in units of its depth, beyond which a texel is hidden."""
CHUNK = 1 << 20
"""Texels projected at a time, and pixels tested at a time."""
PADDING = 2
"""Texels between charts."""
SMALLEST_SIDE = 16
LARGEST_SIDE = 8_192
NEAR = 1e-3
"""Smallest depth of a corner of a face that is drawn, in units of the median depth."""

Picture = tuple[Camera, np.ndarray, np.ndarray | None]
"""A view: its camera, its picture [H, W, 3] in [0, 1], and the mask [H, W] of the pixels that count, or None."""


def texture_mesh(mesh: Mesh, pictures: Iterable[Picture], *, size: int = 2048) -> Mesh:
    """Return the mesh with a texture atlas filled from pictures.

    A texel is the weighted mean of the pictures that show it. The weight is (cosine·focal length/distance)⁶, so that
    near, frontal views dominate. Hidden texels are found by rasterizing the mesh in each view. Texels that no view
    shows keep the vertices' colours.

    Args:
      mesh: a mesh in the world of the cameras.
      pictures: (camera, picture [H, W, 3] in [0, 1], mask [H, W] of the pixels that count, or None).
      size: side of the atlas in texels.

    Returns:
      The mesh with `uv` and `texture`; vertices at the seams of charts are repeated.

    Raises:
      ValueError: if xatlas is not installed (`pip install 'a2tg-jax[mesh]'`), the size is out of range, a camera has
        the rays of a lens, a picture or mask is of another size than its camera, a picture holds no floats or a mask no
        bools.
    """
    mesh, texels = _unwrapped(mesh, size)
    total = np.zeros((len(texels.place), 3), np.float32)
    weight = np.zeros(len(texels.place), np.float32)
    for camera, picture, mask in pictures:
        if camera.rays is not None:
            raise ValueError("a texture needs pictures of pinhole cameras; got one with the rays of a lens")
        check_floats("picture", picture, (camera.height, camera.width, 3))
        if mask is not None:
            check_mask("mask", mask, (camera.height, camera.width))
        depth = draw_view(mesh, camera).depth
        for start in range(0, len(weight), CHUNK):
            part = Texels(*(rows[start : start + CHUNK] for rows in texels))
            seen, weights, color = _seen(part, camera, np.asarray(picture, np.float32), mask, depth)
            weight[start + seen] += weights
            total[start + seen] += weights[:, None] * color
    color = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-30)[:, None], texels.color)
    atlas = np.zeros((size, size, 3), np.uint8)
    is_empty = np.ones((size, size), bool)
    atlas.reshape(-1, 3)[texels.place] = np.rint(255 * np.clip(color, 0, 1))
    is_empty.flat[texels.place] = False
    if not is_empty.all():  # Between charts, the nearest texel's colour keeps seams from showing.
        atlas = atlas[tuple(distance_transform_edt(is_empty, return_distances=False, return_indices=True))]
    return Mesh(mesh.vertices, mesh.faces, mesh.colors, mesh.uv, atlas)


def check_texture(size: int) -> Any:
    """Return the library xatlas. ValueError: it is not installed, or the side of an atlas is out of range."""
    if not SMALLEST_SIDE <= size <= LARGEST_SIDE:
        raise ValueError(f"texture_size must be in {SMALLEST_SIDE}..{LARGEST_SIDE} texels; got {size}")
    return optional("xatlas", "a texture needs xatlas", "mesh")


class Texels(NamedTuple):
    """Texels that charts cover."""

    place: np.ndarray  # [T] number in the atlas, row by row from the top.
    position: np.ndarray  # [T, 3] float32 position in the world.
    normal: np.ndarray  # [T, 3] float32 unit normal of the face.
    color: np.ndarray  # [T, 3] float32 interpolated vertex colour in [0, 1]; grey without vertex colours.


def _unwrapped(mesh: Mesh, size: int) -> tuple[Mesh, Texels]:
    """Return the mesh with positions in a square atlas of `size`, by xatlas, and the texels that its charts cover."""
    xatlas = check_texture(size)
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32))
    options = xatlas.PackOptions()
    options.resolution = size
    options.padding = PADDING
    options.bruteForce = False
    atlas.generate(xatlas.ChartOptions(), options)
    source, faces, uv = atlas.get_mesh(0)
    colors = None if mesh.colors is None else mesh.colors[source]
    uv = np.asarray(uv, np.float32)
    mesh = Mesh(mesh.vertices[source], faces.astype(np.int32), colors, uv)
    # uv begins at the lower left, rows of the atlas at the top.
    corners = (uv * (size, -size) + (0, size)).astype(np.float32)[mesh.faces]
    # At one depth: charts do not overlap.
    drawn = _draw(corners, np.ones(mesh.faces.shape, np.float32), size, size)
    place = np.flatnonzero(drawn.face >= 0)
    hit = drawn.face.reshape(-1)[place]
    weights = drawn.weights.reshape(-1, 3)[place]
    normals = mesh.face_normals[hit]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    if colors is None:
        colors = np.full((mesh.num_vertices, 3), 128, np.uint8)
    position, color = (
        np.einsum("tk,tkc->tc", weights, rows[mesh.faces[hit]].astype(np.float32)) for rows in (mesh.vertices, colors)
    )
    return mesh, Texels(place, position, normals.astype(np.float32), color / 255)


def _seen(
    texels: Texels, camera: Camera, picture: np.ndarray, mask: np.ndarray | None, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the texels visible in a view, as indices [S], and their weights [S] and colours [S, 3] there. Those beyond
    the mesh's depth [H, W] are hidden."""
    viewmat = np.asarray(camera.viewmat, np.float32)
    K = np.asarray(camera.K, np.float32)
    at = texels.position @ viewmat[:3, :3].T + viewmat[:3, 3]
    # In camera axes: distance times the cosine between normal and the direction to the camera.
    toward = -np.sum(at * (texels.normal @ viewmat[:3, :3].T), axis=1)
    seen = np.flatnonzero((at[:, 2] > 0) & (toward > 0))
    at = at[seen]
    toward = toward[seen]
    x, y = ((at / at[:, 2:]) @ K[:2].T).T
    distance = np.linalg.norm(at, axis=1)
    is_inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height) & (toward > LEAST_FACING * distance)
    # Any valid index will do outside; is_inside excludes these.
    row, column = (np.where(is_inside, each, 0).astype(int) for each in (y, x))
    is_seen = is_inside & (at[:, 2] < (1 + HIDDEN) * depth[row, column])
    if mask is not None:
        is_seen &= mask[row, column]
    # map_coordinates has pixel centres at whole numbers.
    places = np.stack([y, x])[:, is_seen] - np.float32(0.5)
    channels = [map_coordinates(picture[..., channel], places, order=1, mode="nearest") for channel in range(3)]
    distance = distance[is_seen]
    # cosine·focal length/distance: `toward` is the cosine times the distance.
    weights = (toward[is_seen] * K[0, 0] / camera.width / distance**2) ** POWER
    return seen[is_seen], weights.astype(np.float32), np.stack(channels, -1)


# Triangles drawn into pixels


class Raster(NamedTuple):
    """Faces and places of pixels."""

    face: np.ndarray  # [H, W] int32 face of each pixel; -1 without one.
    weights: np.ndarray  # [H, W, 3] float32 barycentric coordinates there.
    depth: np.ndarray  # [H, W] float32 depth there; infinite without a face.


def draw_view(mesh: Mesh, camera: Camera) -> Raster:
    """Draw a mesh in a camera's view, without faces that reach behind the camera."""
    viewmat = np.asarray(camera.viewmat, np.float64)
    K = np.asarray(camera.K, np.float64)
    at = mesh.vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = at[:, 2]
    # Faces at the camera plane would have infinite pixels.
    least = NEAR * np.median(z[z > 0]) if (z > 0).any() else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.where(z[:, None] > least, (at / z[:, None]) @ K[:2].T, np.nan)
    return _draw(pixels[mesh.faces].astype(np.float32), z[mesh.faces].astype(np.float32), camera.width, camera.height)


def _draw(points: np.ndarray, depths: np.ndarray, width: int, height: int) -> Raster:
    """Draw triangles of corners [F, 3, 2] in pixels, NaN if not drawn, at depths [F, 3]; the nearest one shows."""
    face = np.full(width * height, -1, np.int32)
    nearest = np.full(width * height, np.inf, np.float32)
    weights = np.zeros((width * height, 3), np.float32)
    for faces, pixels in _candidates(points, width, height):
        a, b, c = points[faces].transpose(1, 0, 2)
        along = b - a
        across = c - a
        place = np.stack([pixels % width, pixels // width], -1) + np.float32(0.5) - a
        area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # Triangles without area become NaN and cover no pixels.
            second = (place[:, 0] * across[:, 1] - place[:, 1] * across[:, 0]) / area
            third = (along[:, 0] * place[:, 1] - along[:, 1] * place[:, 0]) / area
            barycentric = np.stack([1 - second - third, second, third], -1)
        depth = 1 / np.sum(barycentric / depths[faces], axis=1)  # Inverse depths are linear in the image.
        shows = np.flatnonzero((barycentric >= 0).all(axis=1) & (depth < nearest[pixels]))
        shows = shows[np.argsort(-depth[shows], kind="stable")]  # The nearest is written last.
        chosen = pixels[shows]
        face[chosen] = faces[shows]
        nearest[chosen] = depth[shows]
        weights[chosen] = barycentric[shows]
    # Perspective: what is linear on the triangle is linear over depth in the image.
    corrected = weights / np.where(face[:, None] >= 0, depths[face], 1.0)
    corrected /= np.maximum(corrected.sum(axis=1, keepdims=True), 1e-30)
    shape = (height, width)
    return Raster(face.reshape(shape), corrected.reshape(*shape, 3).astype(np.float32), nearest.reshape(shape))


def _candidates(points: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (faces, pixels) [P] of the pixels within the bounds of each face, some at a time."""
    with np.errstate(invalid="ignore"):
        # Pixels whose centres, at half-integers, are within the bounds.
        low = np.maximum(np.ceil(points.min(axis=1) - 0.5), 0)
        high = np.minimum(np.floor(points.max(axis=1) - 0.5), (width - 1, height - 1))
        order = np.flatnonzero((high >= low).all(axis=1))
    low = low[order].astype(np.int64)
    span = high[order].astype(np.int64) - low + 1
    areas = span.prod(axis=1)
    ends = np.cumsum(areas)
    # Chunks of whole faces, so that arrays stay bounded, however large faces are in the image.
    start = done = 0
    while start < len(order):
        # At least one face, even if it alone exceeds the chunk.
        end = max(start + 1, int(np.searchsorted(ends, done + CHUNK, side="right")))
        rows = np.repeat(np.arange(start, end), areas[start:end])
        index = done + np.arange(len(rows)) - (ends - areas)[rows]  # Number of the pixel within its face's bounds.
        row, column = np.divmod(index, span[rows, 0])
        yield order[rows], (low[rows, 1] + row) * width + low[rows, 0] + column
        start = end
        done = int(ends[end - 1])
