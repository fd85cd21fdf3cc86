"""From splats to pixels: homographies, the ray-splat intersection, tight bounds on the screen, sizes in pixels.

M [3, 3] takes (u, v, 1), in standard deviations of the splat, to homogeneous pixels: equation (1) of 2DGS as a 3×3
matrix, M = K·[Rc·R₀·s_x | Rc·R₁·s_y | Rc·μ + t]. Its last row gives the depth. N splats, rows M₀, M₁, M₂.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians, rotation_columns

FILTER_VARIANCE = 0.5
"""Variance in pixels² of the low-pass filter: ρ₂ = 2·|(x, y) − c|²."""
NEAR_PLANE = 0.2
"""Default smallest depth at which splats are drawn."""
POLYGON_SIDES = 8  # its corners are 8 % outside the disc, 1 / cos(π/8)
BOUND_SLACK = 1e-2
"""Margin of every bound for rounding, in squared pixels."""
Box = tuple[Array, Array, Array, Array]
"""Left, top, right and bottom edge, in pixels."""
Floats = Array | np.ndarray


def pixel_sizes(means: Floats, scales: Floats, viewmat: Floats, K: Floats) -> Floats:
    """Return the smaller standard deviation of Gaussians in pixels [N], of NumPy or JAX; 0 at depths up to the near
    plane."""
    depths = means @ viewmat[2, :3] + viewmat[2, 3]
    # The geometric mean, for pixels that are not square.
    focal = (K[0, 0] * K[1, 1]) ** 0.5
    return (depths > NEAR_PLANE).astype(depths.dtype) * scales.min(axis=1) * focal / depths.clip(NEAR_PLANE)


def homographies_of(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """Return M [N, 3, 3] and normals [N, 3] in the world, turned to face the camera."""
    # Number by number: CPUs vectorise over N, but not over axes of 2 and 3.
    x_axis, y_axis, normal = rotation_columns(tuple(gaussians.quats[:, k] for k in range(4)))
    mean = tuple(gaussians.means[:, k] for k in range(3))
    scale_x = gaussians.scales[:, 0]
    scale_y = gaussians.scales[:, 1]
    to_pixels = camera.K @ camera.viewmat[:3]

    # Row i of equation (1): the axes are directions, only the mean is translated.
    def row(i: int) -> list[Array]:
        u, v, w = (sum(to_pixels[i, k] * axis[k] for k in range(3)) for axis in (x_axis, y_axis, mean))
        return [scale_x * u, scale_y * v, w + to_pixels[i, 3]]

    M = jnp.stack([number for i in range(3) for number in row(i)], axis=1).reshape(-1, 3, 3)
    towards_camera = sum(normal[k] * (camera.center[k] - mean[k]) for k in range(3))
    return M, jnp.stack([jnp.where(towards_camera < 0, -number, number) for number in normal], axis=1)


class Outline(NamedTuple):
    """Outline of all that a splat draws: an ellipse, or a circle around the mean, which the low-pass filter reaches.

    Inside the ellipse, (x − e)ᵀS⁻¹(x − e) <= 1 with S = [[xx, xy], [xy, yy]]. Lengths are in pixels.
    """

    ellipse_x: Array
    ellipse_y: Array
    xx: Array
    xy: Array
    yy: Array
    mean_x: Array  # Centre of the circle: the projected mean.
    mean_y: Array
    radius: Array
    is_clipped: Array  # Whether the disc reaches behind the near plane: only the box is then valid.


class ScreenBounds(NamedTuple):
    """Conservative boxes of pixels in which splats can reach 1/255; [N] each."""

    left: Array
    top: Array
    right: Array  # Less than `left` if the splat is invisible, as `bottom` is then less than `top`.
    bottom: Array
    outline: Outline


def screen_bounds(M: Array, cutoff: Array, near_plane: float) -> ScreenBounds:
    """Return the bounds on the screen of the discs u² + v² <= cutoff, joined with the low-pass filter's reach.

    The cutoff [N] is r² = 2·ln(255·o·max T_A); a splat with r² <= 0 is invisible. Hits have depths from `near_plane`
    on.
    """
    # Both boxes are computed for all splats: a branch would be the slow one as soon as one splat needs it.
    rows = tuple(tuple(M[:, i, k] for k in range(3)) for i in range(3))
    bounds = unclipped_bounds(rows, cutoff, near_plane)
    clipped = clipped_box(rows, bounds.outline, cutoff, near_plane)
    is_clipped = bounds.outline.is_clipped
    left, top, right, bottom = (jnp.where(is_clipped, a, b) for a, b in zip(clipped, bounds[:4], strict=True))
    return ScreenBounds(left, top, right, bottom, bounds.outline)


def unclipped_bounds(M: Sequence[Sequence[Array]], cutoff: Array, near_plane: float) -> ScreenBounds:
    """Return `screen_bounds` of rows M[i][k]; element-wise. If the outline is clipped, the box is meaningless.

    M is shifted to the projected mean, which keeps float32 exact to a fraction of a pixel.
    """
    last_u, last_v, depth = M[2]
    is_visible = (depth >= near_plane) & (cutoff > 0)
    # Stand-ins for invisible splats, whose division might give infinities or NaN.
    depth = jnp.where(is_visible, depth, 1.0)
    r2 = jnp.where(is_visible, cutoff, 0.0)
    mean_x = M[0][2] / depth
    mean_y = M[1][2] / depth
    x_u = M[0][0] - mean_x * last_u
    x_v = M[0][1] - mean_x * last_v
    y_u = M[1][0] - mean_y * last_u
    y_v = M[1][1] - mean_y * last_v
    spread2 = r2 * (last_u * last_u + last_v * last_v)
    # The least depth on the disc is the mean's minus r·|(M₂₀, M₂₁)|.
    is_clipped = is_visible & (depth - jnp.sqrt(spread2) < near_plane)

    # The dual conic of the disc is C = M·diag(r², r², −1)·Mᵀ. After division by C₃₃ = spread2 − depth², its last column
    # is the centre e, relative to the projected mean, and S = e·eᵀ minus its upper block.
    scale = jnp.where(is_clipped, 0.0, r2 / jnp.where(is_clipped, 1.0, depth * depth - spread2))
    shift_x = -scale * (x_u * last_u + x_v * last_v)
    shift_y = -scale * (y_u * last_u + y_v * last_v)
    ellipse_x = mean_x + shift_x
    ellipse_y = mean_y + shift_y
    xx = (shift_x * shift_x + scale * (x_u * x_u + x_v * x_v)) * (1 + 1e-4) + BOUND_SLACK
    xy = (shift_x * shift_y + scale * (x_u * y_u + x_v * y_v)) * (1 + 1e-4)
    yy = (shift_y * shift_y + scale * (y_u * y_u + y_v * y_v)) * (1 + 1e-4) + BOUND_SLACK
    # The low-pass filter, ρ = 2·|x − c|², reaches r/√2 pixels.
    half_x = jnp.sqrt(xx)
    half_y = jnp.sqrt(yy)
    radius = jnp.sqrt(r2 / 2 + BOUND_SLACK)
    return ScreenBounds(
        left=jnp.where(is_visible, jnp.minimum(ellipse_x - half_x, mean_x - radius), 1.0),
        top=jnp.where(is_visible, jnp.minimum(ellipse_y - half_y, mean_y - radius), 1.0),
        right=jnp.where(is_visible, jnp.maximum(ellipse_x + half_x, mean_x + radius), -1.0),
        bottom=jnp.where(is_visible, jnp.maximum(ellipse_y + half_y, mean_y + radius), -1.0),
        outline=Outline(ellipse_x, ellipse_y, xx, xy, yy, mean_x, mean_y, radius, is_clipped),
    )


def clipped_box(M: Sequence[Sequence[Array]], outline: Outline, cutoff: Array, near_plane: float) -> Box:
    """Return the box of the polygon around a disc, cut at the near plane; element-wise. It is valid only if the
    outline is clipped."""
    angles = np.arange(POLYGON_SIDES) * (2 * np.pi / POLYGON_SIDES)
    reach = jnp.sqrt(jnp.maximum(cutoff, 0.0)) / math.cos(math.pi / POLYGON_SIDES)
    # A regular polygon whose sides touch the disc contains it; its corners are at r / cos(π/n).
    points = []
    for cosine, sine in zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True):
        u = reach * cosine
        v = reach * sine
        points.append(tuple(row[0] * u + row[1] * v + row[2] for row in M))

    mean_x = outline.mean_x
    mean_y = outline.mean_y
    radius = outline.radius
    box = mean_x, mean_y, mean_x, mean_y

    def joined(box: Box, is_valid: Array, point: Sequence[Array]) -> Box:
        x, y, depth = point
        # A point that is not valid adds the mean, where the box begins.
        depth = jnp.where(is_valid, jnp.maximum(depth, near_plane), 1.0)
        x = jnp.where(is_valid, x / depth, mean_x)
        y = jnp.where(is_valid, y / depth, mean_y)
        return jnp.minimum(box[0], x), jnp.minimum(box[1], y), jnp.maximum(box[2], x), jnp.maximum(box[3], y)

    # As Sutherland and Hodgman clip polygons: corners beyond the plane count, and edges where they cross it.
    for point, following in zip(points, points[1:] + points[:1], strict=True):
        is_beyond = point[2] >= near_plane
        box = joined(box, is_beyond, point)
        crosses = is_beyond != (following[2] >= near_plane)
        fraction = jnp.where(crosses, (near_plane - point[2]) / jnp.where(crosses, following[2] - point[2], 1.0), 0.0)
        cut = tuple(a + fraction * (b - a) for a, b in zip(point, following, strict=True))
        box = joined(box, crosses, cut)
    left, top, right, bottom = box
    margin_x = 1e-3 * (right - left) + BOUND_SLACK
    margin_y = 1e-3 * (bottom - top) + BOUND_SLACK
    return (
        jnp.minimum(left - margin_x, mean_x - radius),
        jnp.minimum(top - margin_y, mean_y - radius),
        jnp.maximum(right + margin_x, mean_x + radius),
        jnp.maximum(bottom + margin_y, mean_y + radius),
    )
