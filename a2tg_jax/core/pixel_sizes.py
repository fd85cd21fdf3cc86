"""Sizes of Gaussians on the screen, and the low-pass filter below which they are drawn no smaller."""

from typing import Any

FILTER_VARIANCE = 0.5
"""Variance in pixels² of the low-pass filter: ρ₂ = 2·|(x, y) − c|²."""
NEAR_PLANE = 0.2
"""Default depth from which splats are drawn."""


def pixel_sizes(means: Any, scales: Any, viewmat: Any, K: Any) -> Any:
    """Return the smaller standard deviation of Gaussians in pixels [N]; 0 before the near plane.

    Args:
      means: [N, 3], NumPy or JAX.
      scales: [N, 2] standard deviations.
      viewmat, K: [4, 4] and [3, 3] of a camera.
    """
    depths = means @ viewmat[2, :3] + viewmat[2, 3]
    focal = (K[0, 0] * K[1, 1]) ** 0.5
    return (depths > NEAR_PLANE).astype(depths.dtype) * scales.min(axis=1) * focal / depths.clip(NEAR_PLANE)
