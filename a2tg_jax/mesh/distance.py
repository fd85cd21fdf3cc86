"""Distances between surfaces: accuracy, completeness, Chamfer distance and F-score of point samples (host)."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.mesh.triangles import Mesh

MOST_POINTS = 200_000_000
"""Largest number of points of a sample, of 24 bytes each and as much again while they are drawn."""
CHUNK = 1 << 20
"""Points that are placed at a time."""


class SurfaceDistance(NamedTuple):
    """Distances between a surface and its reference.

    Accuracy, completeness and Chamfer distance are lengths, named as DTU's evaluation names them: lower is better.
    Precision, recall and F-score are shares from 0 to 1: higher is better.
    """

    accuracy: float
    """Mean distance of the surface's points from the reference, in scene units; lower is better."""
    completeness: float
    """Mean distance of the reference's points from the surface, in scene units; lower is better."""
    precision: float
    """Share of the surface's points that lie within the threshold of the reference; higher is better."""
    recall: float
    """Share of the reference's points that lie within the threshold of the surface; higher is better."""

    @property
    def chamfer(self) -> float:
        """Mean of accuracy and completeness, as DTU's evaluation of splats reports it; lower is better."""
        return (self.accuracy + self.completeness) / 2

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall, 0 if both are 0; higher is better."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


def surface_distance(
    points: np.ndarray, reference: np.ndarray, *, threshold: float, most: float = np.inf
) -> SurfaceDistance:
    """Compare the points of a surface with those of its reference.

    Args:
      points: [P, 3] points on the surface, such as `sample_surface` gives.
      reference: [R, 3] points on the true surface.
      threshold: largest distance that counts as met, for precision, recall and F-score.
      most: distances beyond it are left out of the means, as DTU's evaluation does with 20 mm.

    Returns:
      The distances; infinite means and shares of 0 if one of the two has no points.
    """
    if not len(points) or not len(reference):
        return SurfaceDistance(np.inf, np.inf, 0.0, 0.0)
    forth, _ = cKDTree(reference).query(points, workers=-1)
    back, _ = cKDTree(points).query(reference, workers=-1)
    accuracy, completeness = (
        float(each[each < most].mean()) if (each < most).any() else np.inf for each in (forth, back)
    )
    return SurfaceDistance(accuracy, completeness, float((forth < threshold).mean()), float((back < threshold).mean()))


def sample_surface(mesh: Mesh, spacing: float, seed: int = 0) -> np.ndarray:
    """Return random points [P, 3] on a mesh, evenly by area, one for each square of side `spacing`.

    Raises:
      ValueError: if these are more than 200,000,000.
    """
    areas = np.linalg.norm(mesh.face_normals, axis=1) / 2
    wanted = np.ceil(areas.sum() / spacing**2) if len(areas) else 0
    if not wanted <= MOST_POINTS:
        raise ValueError(f"spacing {spacing:g} takes {wanted:.3g} points; give one for up to {MOST_POINTS:,}")
    points = np.zeros((num := int(wanted), 3))
    if not num:
        return points
    rng = np.random.default_rng(seed)
    ends = np.cumsum(areas)
    chosen = np.searchsorted(ends, (np.arange(num) + rng.uniform(size=num)) * (ends[-1] / num))
    a, b = np.sqrt(rng.uniform(size=num)), rng.uniform(size=num)
    chosen = np.minimum(chosen, len(areas) - 1)
    for part in (slice(start, start + CHUNK) for start in range(0, num, CHUNK)):
        weights = np.stack([1 - a[part], a[part] * (1 - b[part]), a[part] * b[part]], -1)
        points[part] = np.einsum("pk,pkc->pc", weights, mesh.vertices[mesh.faces[chosen[part]]])
    return points
