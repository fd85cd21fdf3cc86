"""The space that voxels divide: even within a radius, and coarser with the distance beyond.

Voxel i [3] lies at y = voxel·i, relative to the centre. Within the radius R, x = y. Beyond it, an unbounded space has
|x| = R·exp(|y|/R - 1) in the same direction: voxels grow in proportion to their distance, as pixels do.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax.core.capture_geometry import nearest_point
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.similarity import camera_centers

TRUNCATION = 5.0
"""Truncation of signed distances in voxels."""
FARTHEST = 1e3
"""Largest distance from the centre in an unbounded space, in radii."""
RADII = 2.0
"""Default radius, in median distances of the cameras from the centre."""


@pytree
class Space:
    """Centre, radius and voxels."""

    center: Array
    """[3] position of voxel 0."""
    radius: Array
    """[] radius within which voxels are even."""
    voxel: Array
    """[] side of a voxel within the radius."""
    is_unbounded: bool = dataclasses.field(default=False, metadata={"static": True})
    """Whether the space goes on beyond the radius."""

    @staticmethod
    def of(center: np.ndarray, radius: float, voxel: float, is_unbounded: bool) -> "Space":
        """Make a space of numbers of the host."""
        return Space(jnp.asarray(center, jnp.float32), jnp.float32(radius), jnp.float32(voxel), is_unbounded)

    def positions(self, indices: Array) -> Array:
        """Return positions [..., 3] of voxels in the world; indices may be fractions."""
        offset = indices.astype(jnp.float32) * self.voxel
        return self.center.reshape((1,) * (indices.ndim - 1) + (3,)) + offset * self._growth(offset)[..., None]

    def _growth(self, offset: Array) -> Array:
        """Return |x|/|y| at offsets y."""
        if not self.is_unbounded:
            return jnp.ones(offset.shape[:-1], jnp.float32)
        ratio = jnp.linalg.norm(offset, axis=-1) / self.radius
        return jnp.where(ratio > 1, jnp.exp(jnp.maximum(ratio, 1.0) - 1) / jnp.maximum(ratio, 1.0), 1.0)

    def indices(self, points: Array) -> Array:
        """Return the indices [..., 3] of positions, as fractions."""
        offset = points - self.center.reshape((1,) * (points.ndim - 1) + (3,))
        if self.is_unbounded:
            ratio = jnp.maximum(jnp.linalg.norm(offset, axis=-1, keepdims=True) / self.radius, 1.0)
            offset = offset * ((1 + jnp.log(ratio)) / ratio)
        return offset / self.voxel

    def scale(self, points: Array) -> Array:
        """Return the size of voxels at positions [..., 3], relative to that within the radius."""
        return jnp.maximum(self._ratio(points), 1.0) if self.is_unbounded else jnp.ones(points.shape[:-1], jnp.float32)

    def contains(self, points: Array) -> Array:
        """Return [...] whether positions lie within the space."""
        return self._ratio(points) <= (FARTHEST if self.is_unbounded else 1.0)

    def _ratio(self, points: Array) -> Array:
        offset = points - self.center.reshape((1,) * (points.ndim - 1) + (3,))
        ratio: Array = jnp.linalg.norm(offset, axis=-1) / self.radius
        return ratio


def common_sphere(viewmats: ArrayLike) -> tuple[np.ndarray, float]:
    """Return centre [3] and radius of the sphere that cameras [V, 4, 4] look at.

    The centre is the point nearest to all optical axes, the radius twice the median distance of the cameras from it.
    """
    viewmats = np.asarray(viewmats, np.float64)
    centers = camera_centers(viewmats)
    center = nearest_point(centers, viewmats[:, 2, :3]) if len(viewmats) > 1 else centers[0]
    return center, float(RADII * np.median(np.linalg.norm(centers - center, axis=1)))
