"""Marching cubes over sparse voxels, in bricks of many blocks (host)."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from a2tg_jax.mesh.blocks import SIDE, VOXELS, BlockGrid
from a2tg_jax.mesh.space import Space
from a2tg_jax.mesh.triangles import Mesh

BRICK = 16
"""Blocks along a side of a brick."""
SAME = 1e-3
"""Distance in voxels of vertices that two bricks share."""


def surface_of(grid: BlockGrid, space: Space, least_weight: float = 0.0) -> Mesh:
    """Return the surface where the mean signed distance is zero, with colours.

    Args:
      grid: fused views.
      space: the space of its voxels.
      least_weight: voxels of no larger weight are unknown, and their cells have no surface.
    """
    parts = list(_parts(grid, least_weight))
    if not parts:
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _, _ in parts])
    faces = np.concatenate([faces + start for (_, faces, _), start in zip(parts, starts[:-1], strict=True)])
    colors = np.concatenate([colors for _, _, colors in parts])
    vertices, faces, colors = _welded(vertices, faces, colors)
    positions = np.asarray(space.positions(jnp.asarray(vertices, jnp.float32)))
    return Mesh(positions, faces.astype(np.int32), colors)


def _parts(grid: BlockGrid, least_weight: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return vertices in voxels, faces and colours of each brick that has a surface."""
    from skimage import measure

    marching_cubes: Any = measure.marching_cubes

    for brick in np.unique(grid.coordinates // BRICK, axis=0):
        distance, is_known, color = _brick(grid, brick, least_weight)
        cells = _all_corners(is_known)
        if not cells.any() or not distance.min() < 0 < distance.max():
            continue
        mask = np.zeros(distance.shape, bool)
        mask[1:, 1:, 1:] = cells  # A cell is asked for by its last corner.
        try:
            vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=mask, gradient_direction="descent")
        except RuntimeError:  # No cell has a surface.
            continue
        at = np.rint(vertices).astype(int)
        yield vertices.astype(np.float64) + brick * (BRICK * SIDE), faces, color[tuple(at.T)]


def _brick(grid: BlockGrid, brick: np.ndarray, least_weight: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean distances, whether they are known, and colours of a brick and the first voxels of the next ones."""
    steps = np.stack(np.meshgrid(*[np.arange(BRICK + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    rows = grid.find(brick * BRICK + steps)
    found = np.flatnonzero(rows >= 0)
    rows = rows[found]
    weight = grid.weight[rows]
    known = weight > least_weight
    mean = np.where(known, grid.distance[rows] / np.where(known, weight, 1.0), 1.0)
    color = np.rint(255 * np.clip(grid.color[rows].astype(np.float32), 0, 1)).astype(np.uint8)
    return (
        _dense(mean.astype(np.float32), found, np.float32(1)),
        _dense(known, found, np.bool_(False)),
        _dense(color, found, np.uint8(0)),
    )


def _dense(values: np.ndarray, places: np.ndarray, empty: np.generic) -> np.ndarray:
    """Return blocks of values [B, VOXELS, ...] as one array of the brick's voxels."""
    num = BRICK + 1
    whole = np.full((num**3, VOXELS, *values.shape[2:]), empty, values.dtype)
    whole[places] = values
    whole = whole.reshape(num, num, num, SIDE, SIDE, SIDE, *values.shape[2:])
    order = (0, 3, 1, 4, 2, 5, *range(6, whole.ndim))
    whole = whole.transpose(order).reshape(*[num * SIDE] * 3, *values.shape[2:])
    end = BRICK * SIDE + 1
    return whole[:end, :end, :end]


def _all_corners(is_known: np.ndarray) -> np.ndarray:
    """Return for each cell whether all its corners are known."""
    for axis in range(3):
        first = [slice(None)] * 3
        last = [slice(None)] * 3
        first[axis], last[axis] = slice(0, -1), slice(1, None)
        is_known = is_known[tuple(first)] & is_known[tuple(last)]
    return is_known


def _welded(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the parts with one vertex where bricks share it, without the faces that have lost an edge."""
    side = BRICK * SIDE
    on_border = np.flatnonzero((np.abs(vertices - side * np.rint(vertices / side)) < SAME).any(axis=1))
    pairs = on_border[cKDTree(vertices[on_border]).query_pairs(SAME, output_type="ndarray")] if len(on_border) else []
    if not len(pairs):
        return vertices, faces, colors
    num = len(vertices)
    graph = coo_matrix((np.ones(len(pairs), bool), tuple(np.transpose(pairs))), (num, num))
    _, labels = connected_components(graph, directed=False)
    _, first = np.unique(labels, return_index=True)
    faces = labels[faces]
    a, b, c = faces.T
    return vertices[first], faces[(a != b) & (b != c) & (a != c)], colors[first]
