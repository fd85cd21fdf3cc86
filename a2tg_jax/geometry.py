"""From splats to pixels: homographies, the ray-splat intersection, and tight bounds on the screen.

M [3, 3] takes (u, v, 1), in standard deviations of the splat, to homogeneous pixels: equation (1) of 2DGS as a 3×3
matrix, M = K·[Rc·R₀·s_x | Rc·R₁·s_y | Rc·μ + t]. Its last row gives the depth. N splats, rows M₀, M₁, M₂.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.cameras import Camera
from a2tg_jax.gaussians import Gaussians, rotation_matrices

POLYGON_SIDES = 8
BOUND_SLACK = 1e-2
"""Squared pixels added to every bound, for rounding."""


def homographies(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """M [N, 3, 3] of each splat, and its normals [N, 3] in the world, turned to face the camera."""
    rotations = rotation_matrices(gaussians.quats)
    to_camera, offset = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    scales = gaussians.scales
    columns = [
        rotations[:, :, 0] * scales[:, 0:1] @ to_camera.T,
        rotations[:, :, 1] * scales[:, 1:2] @ to_camera.T,
        gaussians.means @ to_camera.T + offset[None, :],
    ]
    local_to_camera = jnp.stack(columns, axis=-1)
    normals = rotations[:, :, 2]
    towards_camera = jnp.sum(normals * (camera.center[None, :] - gaussians.means), axis=-1, keepdims=True)
    return jnp.einsum("ij,njk->nik", camera.K, local_to_camera), jnp.where(towards_camera < 0, -normals, normals)


class ScreenBounds(NamedTuple):
    """Where N splats can reach 1/255, in pixels, conservatively."""

    lower: Array
    """[N, 2] smallest x and y."""
    upper: Array
    """[N, 2] largest x and y; below `lower` where the splat is invisible."""
    means2d: Array
    """[N, 2] projected means c."""
    ellipse_center: Array
    """[N, 2] centre of the outline's ellipse."""
    ellipse: Array
    """[N, 3] (xx, xy, yy) of the matrix S with (x − e)ᵀS⁻¹(x − e) <= 1 inside the outline."""
    low_pass_radius: Array
    """[N] radius around c of the low-pass filter's reach."""
    is_clipped: Array
    """[N] the disc reaches behind the near plane: the outline is no ellipse, only the box holds."""


def screen_bounds(M: Array, cutoff: Array, near_plane: float) -> ScreenBounds:
    """Bounds of the discs u² + v² <= cutoff seen on the screen, joined with the low-pass filter's reach.

    Computed with M shifted to the projected mean, which keeps float32 exact to a fraction of a pixel.

    Args:
      M: [N, 3, 3] homographies.
      cutoff: [N] r² = 2·ln(255·o·max T_A); a splat with r² <= 0 shows nowhere.
      near_plane: depths below it are not hit.
    """
    is_visible = (M[:, 2, 2] >= near_plane) & (cutoff > 0)
    depths = jnp.where(is_visible, M[:, 2, 2], 1.0)
    means2d = M[:, :2, 2] / depths[:, None]
    r2 = jnp.where(is_visible, cutoff, 0.0)
    tilt = M[:, 2, :2]
    axes = M[:, :2, :2] - means2d[:, :, None] * tilt[:, None, :]
    is_clipped = is_visible & (depths - jnp.sqrt(r2 * jnp.sum(tilt * tilt, -1)) < near_plane)

    scale = jnp.where(is_clipped, 0.0, r2 / jnp.where(is_clipped, 1.0, depths**2 - r2 * jnp.sum(tilt * tilt, -1)))
    shift = -scale[:, None] * jnp.sum(axes * tilt[:, None, :], -1)
    gram = jnp.stack(
        [
            jnp.sum(axes[:, 0] * axes[:, 0], -1),
            jnp.sum(axes[:, 0] * axes[:, 1], -1),
            jnp.sum(axes[:, 1] * axes[:, 1], -1),
        ],
        -1,
    )
    outer = jnp.stack([shift[:, 0] ** 2, shift[:, 0] * shift[:, 1], shift[:, 1] ** 2], -1)
    slack = jnp.asarray([BOUND_SLACK, 0.0, BOUND_SLACK], M.dtype)
    ellipse = (outer + scale[:, None] * gram) * (1 + 1e-4) + slack[None, :]
    center = means2d + shift
    half = jnp.sqrt(ellipse[:, ::2])
    clipped_lower, clipped_upper = _clipped_box(M, means2d, r2, near_plane)
    lower = jnp.where(is_clipped[:, None], clipped_lower, center - half)
    upper = jnp.where(is_clipped[:, None], clipped_upper, center + half)

    radius = jnp.sqrt(r2 / 2 + BOUND_SLACK)
    lower = jnp.minimum(lower, means2d - radius[:, None])
    upper = jnp.maximum(upper, means2d + radius[:, None])
    nowhere = jnp.asarray([[-1.0]], M.dtype)
    return ScreenBounds(
        lower=jnp.where(is_visible[:, None], lower, -nowhere),
        upper=jnp.where(is_visible[:, None], upper, nowhere),
        means2d=means2d,
        ellipse_center=center,
        ellipse=ellipse,
        low_pass_radius=radius,
        is_clipped=is_clipped,
    )


def _clipped_box(M: Array, means2d: Array, r2: Array, near_plane: float) -> tuple[Array, Array]:
    """Bounding boxes of the polygon around each disc, cut at the near plane: lower and upper corners [N, 2]."""
    angles = np.arange(POLYGON_SIDES) * (2 * np.pi / POLYGON_SIDES)
    unit = np.stack([np.cos(angles), np.sin(angles)], -1) / np.cos(np.pi / POLYGON_SIDES)
    corners = jnp.sqrt(r2)[:, None, None] * jnp.asarray(unit, M.dtype)[None]
    corners = jnp.concatenate([corners, jnp.ones_like(corners[..., :1])], -1)
    points = jnp.einsum("nij,npj->npi", M, corners)
    following = jnp.roll(points, -1, axis=1)
    rise = following[..., 2] - points[..., 2]
    crosses = (points[..., 2] < near_plane) != (following[..., 2] < near_plane)
    fraction = jnp.where(crosses, (near_plane - points[..., 2]) / jnp.where(crosses, rise, 1.0), 0.0)
    cuts = points + fraction[..., None] * (following - points)
    candidates = jnp.concatenate([points, cuts], 1)
    is_valid = jnp.concatenate([points[..., 2] >= near_plane, crosses], 1)
    depths = jnp.where(is_valid, jnp.maximum(candidates[..., 2], near_plane), 1.0)
    pixels = candidates[..., :2] / depths[..., None]
    lower = jnp.min(jnp.where(is_valid[..., None], pixels, means2d[:, None]), axis=1)
    upper = jnp.max(jnp.where(is_valid[..., None], pixels, means2d[:, None]), axis=1)
    margin = 1e-3 * (upper - lower) + BOUND_SLACK
    return lower - margin, upper + margin
