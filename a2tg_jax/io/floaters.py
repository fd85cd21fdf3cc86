"""How much each Gaussian looks like a floater: in front of everything else, alone, and seen by few cameras (host)."""

import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.data.capture_geometry import camera_centers

NUM_NEIGHBOURS = 8
MOST_CAMERAS = 64
"""Largest number of cameras that count, evenly chosen."""
CELLS = 12
"""Number of cells along each side of a picture, each with its own typical depth."""
FEWEST = 8
"""Number of Gaussians in a cell that count as much as the whole picture does."""
FREE = 0.5
"""Octaves up to which a score is 0; nine of ten Gaussians of a surface have fewer."""
LARGEST = 2.5
"""Octaves from which on a score is 255."""
LEAST_DEPTH = 1e-6


def floater_scores(
    means: np.ndarray, log_scales: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray
) -> np.ndarray:
    """Return scores [N] as bytes, from 0, on a surface, to 255. Opacities do not matter.

    Three ratios count, as logarithms to base 2, at least 0:

    * front: the typical depth around a Gaussian in the picture, divided by its own; quadratic mean over the cameras
    * alone: the gap to the nearest Gaussians, an angle from the nearest camera, divided by the scene's median
    * unseen: the median number of cameras that see a Gaussian, divided by the number that see this one

    The score grows with √(front · (alone + unseen)): objects are in front of their background, but not alone, and a
    sparse background is alone, but not in front.

    Args:
      means: [N, 3] positions.
      log_scales: [N, 2].
      viewmats, Ks, sizes: [V, 4, 4], [V, 3, 3] and [V, 2] of the cameras; without cameras only gaps count.
    """
    means = np.asarray(means, np.float64)
    few = slice(None, None, -(-len(viewmats) // MOST_CAMERAS) or 1)
    # Copies at one place count once: they are not neighbours, and a k-d tree would compare each with all of them.
    places, first, place_of = np.unique(means, axis=0, return_index=True, return_inverse=True)
    if len(places) < 2:
        return np.zeros(len(means), np.uint8)
    distances, ids = cKDTree(places).query(places, k=min(NUM_NEIGHBOURS, len(places) - 1) + 1)
    # A gap ends where the neighbour begins. The Gaussian itself does not shorten it, because floaters are large.
    reach = np.exp(np.asarray(log_scales, np.float64).mean(axis=1))[first]
    gaps = np.maximum(distances - reach[ids], 0.1 * distances)[:, 1:].mean(axis=1)[place_of.ravel()]
    if not len(viewmats):
        return _bytes_of(_octaves_over_median(gaps))
    num_views = np.zeros(len(means))
    front = np.zeros(len(means))
    for viewmat, K, (width, height) in zip(viewmats[few], Ks[few], sizes[few], strict=True):
        x, y, depth = viewmat[:3, :3] @ means.T + viewmat[:3, 3:]
        ahead = np.flatnonzero(depth > LEAST_DEPTH)
        column, row, _ = K @ np.stack([x[ahead], y[ahead], depth[ahead]]) / depth[ahead]
        is_seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = ahead[is_seen]
        octaves = np.log2(depth[seen])
        cell = (column[is_seen] / width * CELLS).astype(int) + CELLS * (row[is_seen] / height * CELLS).astype(int)
        # In a cell of few Gaussians most are floaters, so the mean of the picture counts as well.
        picture = FEWEST * octaves.mean() if len(octaves) else 0.0
        typical = (np.bincount(cell, octaves) + picture) / (np.bincount(cell) + FEWEST)
        num_views[seen] += 1
        front[seen] += np.maximum(typical[cell] - octaves, 0) ** 2
    front = np.sqrt(front / np.maximum(num_views, 1))
    away, _ = cKDTree(camera_centers(viewmats)).query(means)
    angles = gaps / np.maximum(away, LEAST_DEPTH)
    unseen = np.log2(np.maximum(max(np.median(num_views), 1.0) / np.maximum(num_views, 0.5), 1.0))
    return _bytes_of(np.sqrt(front * (_octaves_over_median(angles) + unseen)))


def _octaves_over_median(values: np.ndarray) -> np.ndarray:
    # The median of copies at one place is 0.
    typical = np.median(values) or values.max() or 1.0
    return np.log2(np.maximum(values / typical, 1.0))


def _bytes_of(octaves: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip((octaves - FREE) / (LARGEST - FREE), 0, 1)).astype(np.uint8)
